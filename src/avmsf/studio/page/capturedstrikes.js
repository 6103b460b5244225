/** The strikes that a capture holds: listed, marked on the object, each to be heard, redone or taken out. */

import { attempt, button, element, group, warning } from "./dom.js";
import { server, strikePlace } from "./server.js";
import { listenButton } from "./takes.js";

export class CapturedStrikes {
  /** `redo(strike)` records one again, `changed()` is called after one was taken out. */
  constructor(studio, { redo, changed }) {
    Object.assign(this, { studio, redo, changed });
    this.strikes = [];
    this.count = element("h2");
    this.list = element("ul", { className: "listing" });
    this.problems = group();
    this.folder = element("small");
    this.element = group(this.count, this.list, this.problems, this.folder);
    studio.addEventListener("view", () => this.#mark());
  }

  show({ folder, strikes, problems = [] }) {
    this.strikes = strikes;
    this.count.textContent = strikes.length === 1 ? "1 impact" : `${strikes.length} impacts`;
    this.list.hidden = strikes.length === 0;
    this.list.replaceChildren(...strikes.map((strike) => this.#item(strike)));
    this.problems.replaceChildren(...problems.map((words) => warning(words)));
    this.folder.textContent = folder ? `Folder: ${folder}` : "";
    this.#mark();
  }

  #mark() {
    const { view } = this.studio;
    if (!view) return;
    view.unmarkAll("captured-");
    for (const { file, contact } of this.strikes.filter((strike) => strike.contact)) {
      const dot = button("", () => this.#highlight(file), { className: "dot", tabIndex: -1, title: file });
      view.markDot(`captured-${file}`, dot, contact);
    }
  }

  #highlight(file) {
    for (const item of this.list.children) {
      item.classList.toggle("chosen", item.dataset.file === file);
      if (item.dataset.file === file) item.scrollIntoView({ block: "nearest" });
    }
  }

  #item(strike) {
    const { file, warnings = [] } = strike;
    const peak = strike.peak_db === null || strike.peak_db === undefined ? "" : ` ${strike.peak_db.toFixed(1)} dB`;
    return element(
      "li",
      { "data-file": file },
      button(`${file}${peak}`, () => this.#highlight(file), { className: "grow" }),
      listenButton(strikePlace(file)),
      button("Redo", () => this.redo(strike), { className: "small", "aria-label": `Record ${file} again` }),
      button("×", () => this.#remove(strike), { className: "small", "aria-label": `Remove ${file}` }),
      ...warnings.map((words) => warning(words)),
    );
  }

  async #remove({ file, digest }) {
    // What is taken out is gone from the table: ask first.
    if (!confirm(`Remove ${file} from the capture?`)) return;
    await attempt(() => server.removeStrike(file, { digest }), "strike");
    await this.changed();
  }
}

/** Recordings that the server does not have yet: sent, sent again, and told where it cannot be. */

import { button, element, group, line, say, unsay } from "./dom.js";
import { server } from "./server.js";
import { placeInWords } from "./strikeplace.js";
import { listenButton } from "./takes.js";

const RETRY_MS = 3000;

export class Waiting {
  #sending = false;
  #timer = null;

  /** `strikes()` are those that the server has told of, `shown()` the take that is judged elsewhere, `sent()` tells. */
  constructor(outbox, { strikes, shown, sent }) {
    Object.assign(this, { outbox, strikes, shown, sent });
    this.element = group();
    window.addEventListener("online", () => this.send());
  }

  /** Send all that is kept. */
  async send() {
    if (this.#sending) return;
    this.#sending = true;
    clearTimeout(this.#timer);
    let entry;
    while ((entry = this.outbox.entries.find(({ kept, refused }) => kept && !refused))) {
      this.show();
      if (!(await this.#sendOne(entry))) break;
    }
    this.#sending = false;
    this.show();
    await this.sent();
  }

  /** Send a recording; gives whether the server answered at all. */
  async #sendOne(entry) {
    try {
      if (entry.redo) await server.redoStrike(entry.redo, entry.blob, entry);
      else await server.addStrike(entry.blob, entry);
    } catch (error) {
      if (error.unreachable || error.status >= 500) {
        const words = `The recording is not lost, and is sent again until the server answers. ${error.message}`;
        say(`${words} ${this.outbox.refuge}`, { name: "outbox" });
        this.#timer = setTimeout(() => this.send(), RETRY_MS);
        return false;
      }
      // It may have been thrown away while it was on its way.
      if (this.outbox.has(entry.key)) await this.outbox.put({ ...entry, refused: error.message, status: error.status });
      return true;
    }
    await this.outbox.remove(entry.key);
    unsay("outbox");
    return true;
  }

  async keep(entry) {
    await this.outbox.put({ ...entry, kept: true, refused: undefined, status: undefined });
    await this.send();
  }

  show() {
    const entries = this.outbox.entries.filter(({ key }) => key !== this.shown()?.key);
    this.element.replaceChildren(...entries.map((entry) => this.#row(entry)));
  }

  #row(entry) {
    const place = placeInWords(entry);
    const words = !entry.kept
      ? `The recording ${place} is not saved yet.`
      : entry.refused
        ? `The recording ${place} was rejected: ${entry.refused}`
        : `The recording ${place} waits for the server …`;
    const throwAway = () => this.outbox.remove(entry.key).then(() => this.show());
    return group(
      element("p", { className: entry.kept && !entry.refused ? "faint" : "warning" }, words),
      line(...this.#answers(entry), listenButton(entry.blob), button("Discard", throwAway, { className: "small" })),
    );
  }

  /** What can be done with a recording; one that came too late for its strike never takes its place unasked. */
  #answers(entry) {
    const answer = (words, changed = {}) => button(words, () => this.keep({ ...entry, ...changed }), { className: "small" });
    if (!entry.kept) return [answer("Save recording")];
    if (!entry.redo || !entry.refused) return [answer("Send again")];
    const strike = this.strikes().find(({ file }) => file === entry.redo);
    const answers = [];
    if (entry.status === 409 && strike) answers.push(answer("Replace it with mine", { digest: strike.digest }));
    else if (strike) answers.push(answer("Send again"));
    if (entry.contact) answers.push(answer("Add it as a new impact", { redo: null, digest: null }));
    return answers;
  }
}

/** One recording before it is kept: heard, seen and measured at once, then kept or made again. */

import { button, element, line, warning } from "./dom.js";
import { server } from "./server.js";
import { drawTake, listenButton, measures } from "./takes.js";

export class TakeCard {
  /** The recording that is shown, an entry of the outbox; null without one. */
  take = null;

  /** `keep(take)` and `drop(take)` do what its buttons say, `refuge()` tells where a take is without the server. */
  constructor({ keep, drop, refuge }) {
    Object.assign(this, { keep, drop, refuge });
    this.element = element("div", { className: "group", hidden: true });
  }

  async show(take) {
    this.take = take;
    const canvas = element("canvas", { className: "waveform", role: "img", "aria-label": "The recording" });
    const verdict = element("div", {}, element("p", { className: "faint" }, "Measuring …"));
    const answer = (action) => () => {
      this.hide();
      return action(take);
    };
    const keep = button(take.redo ? "Replace" : "Save recording", answer(this.keep), { className: "main" });
    const redo = button("Redo", answer(this.drop));
    this.element.hidden = false;
    this.element.replaceChildren(
      element("h2", {}, "This recording"),
      canvas,
      verdict,
      line(keep, redo, listenButton(take.blob)),
    );
    try {
      const report = await server.checkStrike(take.blob);
      if (this.take !== take) return;
      verdict.replaceChildren(measures(report));
      await drawTake(canvas, take.blob, report.onset_seconds).catch(() => {});
    } catch (error) {
      const again = button("Measure again", () => this.show(take), { className: "small" });
      const refused = error.refusal === true;
      // The check does not know which strike is replaced, as that one's sample rate need not be kept: the server may
      // still take what it refuses here.
      const barred = refused && !take.redo;
      let words = `${error.message} ${error.unreachable ? this.refuge() : ""}`;
      if (barred) words = `It cannot be saved: ${error.message}`;
      else if (refused) words = `${error.message}. This holds for a new impact; the recording may still replace ${take.redo}.`;
      verdict.replaceChildren(warning(words));
      if (!refused) verdict.append(again);
      // What the server would not take shall not look like what is to be done next.
      keep.disabled = barred;
      keep.classList.toggle("main", !barred);
      redo.classList.toggle("main", barred);
    }
  }

  hide() {
    this.take = null;
    this.element.hidden = true;
  }
}

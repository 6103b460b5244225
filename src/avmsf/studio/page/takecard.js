/** One recording before it is kept: heard, seen and measured at once, then kept or made again. */

import { button, element } from "./dom.js";
import { server } from "./server.js";
import { drawTake, listenButton, measures } from "./takes.js";

export class TakeCard {
  /** The recording that is shown, an entry of the outbox; null without one. */
  take = null;

  /** `keep(take)` and `drop(take)` do what its buttons say. */
  constructor({ keep, drop }) {
    Object.assign(this, { keep, drop });
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
    this.element.hidden = false;
    this.element.replaceChildren(
      element("h2", {}, "This recording"),
      canvas,
      verdict,
      element(
        "div",
        { className: "row" },
        button(take.redo ? "Put it in place" : "Keep it", answer(this.keep), { className: "main" }),
        button("Redo", answer(this.drop)),
        listenButton(take.blob),
      ),
    );
    try {
      const report = await server.checkStrike(take.blob);
      if (this.take !== take) return;
      verdict.replaceChildren(measures(report));
      await drawTake(canvas, take.blob, report.onset_seconds).catch(() => {});
    } catch (error) {
      verdict.replaceChildren(element("p", { className: "warning" }, error.message));
      if (error.unreachable) verdict.append(button("Measure again", () => this.show(take), { className: "small" }));
    }
  }

  hide() {
    this.take = null;
    this.element.hidden = true;
  }
}

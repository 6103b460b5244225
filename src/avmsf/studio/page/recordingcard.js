/** One recording before it is saved: listened to, seen and measured at once, then saved or made again. */

import { server } from "./api.js";
import { drawWaveform, listen } from "./audio.js";
import { attempt, button, element, factList, faint, group, line, seconds, smallButton, warning } from "./dom.js";

export class RecordingCard {
  /** The recording that is shown, an entry of the outbox; null without one. */
  entry = null;

  /** `keep(entry)` and `drop(entry)` do what its buttons say, `refuge()` tells where an entry is without the server. */
  constructor({ keep, drop, refuge }) {
    Object.assign(this, { keep, drop, refuge });
    this.element = element("div", { className: "group", hidden: true });
  }

  async show(entry) {
    this.entry = entry;
    const canvas = element("canvas", { className: "waveform", role: "img", "aria-label": "The recording" });
    const verdict = element("div", {}, faint("Measuring …"));
    const answer = (action) => () => {
      this.hide();
      return action(entry);
    };
    const keep = button(entry.redo ? "Replace" : "Save recording", answer(this.keep), { className: "main" });
    const redo = button("Redo", answer(this.drop));
    this.element.hidden = false;
    this.element.replaceChildren(
      element("h2", {}, "This recording"),
      canvas,
      verdict,
      line(keep, redo, listenButton(entry.blob)),
    );
    try {
      const report = await server.checkRecording(entry.blob);
      if (this.entry !== entry) return;
      verdict.replaceChildren(measures(report));
      await drawWaveform(canvas, entry.blob, report.onset_seconds).catch(() => {});
    } catch (error) {
      // The check does not know which recording is replaced, whose sample rate need not be kept: the server may still
      // take what it refuses here.
      const barred = error.refusal && !entry.redo;
      let words = `${error.message} ${error.unreachable ? this.refuge() : ""}`;
      if (barred) words = `It cannot be saved: ${error.message}`;
      else if (error.refusal) words = `${error.message}. As a new impact only: it may still replace ${entry.redo}.`;
      verdict.replaceChildren(warning(words));
      if (!error.refusal) verdict.append(smallButton("Measure again", () => this.show(entry)));
      // What the server would not take shall not look like what is to be done next.
      keep.disabled = barred;
      keep.classList.toggle("main", !barred);
      redo.classList.toggle("main", barred);
    }
  }

  hide() {
    this.entry = null;
    this.element.hidden = true;
  }
}

/** What the server measured, in words; `report` as `capture/check` gives it. */
function measures(report) {
  const rows = [
    ["Peak", report.peak_db === null ? "silence" : `${report.peak_db.toFixed(1)} dB re full scale`],
    ["Clipping", report.clipped ? "yes: the loudest samples are cut off" : "none"],
    ["Onset", report.onset_seconds === null ? "no impact found" : `at ${seconds(report.onset_seconds)}`],
    ["Length", seconds(report.seconds)],
  ];
  const fine = [element("p", { className: "fine" }, "✓ No problems found.")];
  return group(factList(rows), ...(report.warnings.length ? report.warnings.map(warning) : fine));
}

/** A button that plays a recording, a blob or an address. */
export function listenButton(sound) {
  return smallButton("Listen", () => attempt(() => listen(sound), "listen"));
}

/** The button that records a blow, with its level and whether it is cut off, told while it is heard. */

import { button, element, group, say, unsay } from "./dom.js";
import { prepareRecorder, Recorder } from "./recorder.js";

export class RecordButton {
  /** `done(blob)` is called with a recording, `changed()` whenever one begins or ends. */
  constructor({ done, changed = () => {}, main = false }) {
    Object.assign(this, { done, changed });
    this.recorder = new Recorder((told) => this.#tell(told));
    this.button = button("● Record", () => this.#press(), { className: main ? "main" : "" });
    this.meter = element("meter", { min: 0, max: 1, high: 0.95, "aria-label": "Microphone level" });
    this.words = element("small");
    this.clipped = element("p", { className: "warning", role: "alert", hidden: true }, "Clipped: strike with less force.");
    this.level = group(this.meter, this.words, this.clipped);
    prepareRecorder().catch(() => {});
  }

  get busy() {
    return this.recorder.state !== "idle";
  }

  async #press() {
    if (this.busy) {
      if (this.recorder.state === "opening") this.words.textContent = "Stopped before the microphone was open.";
      this.recorder.stop();
      this.#show();
      return;
    }
    unsay("microphone");
    const recorded = this.recorder.record();
    this.words.textContent = "Opening the microphone …";
    this.clipped.hidden = true;
    this.#show();
    try {
      const blob = await recorded;
      this.#show();
      if (blob) await this.done(blob);
    } catch (error) {
      this.#show();
      if (!this.busy) this.words.textContent = "";
      say(error.message, { name: "microphone", bad: true });
    }
  }

  #show() {
    this.button.textContent = this.busy ? "■ Stop" : "● Record";
    this.button.classList.toggle("recording", this.busy);
    this.changed();
  }

  #tell({ level, seconds, struck, clipped }) {
    this.meter.value = level;
    this.words.textContent = `${seconds.toFixed(1)} s, ${struck ? "impact detected" : "waiting for the impact"}`;
    this.clipped.hidden = !clipped;
  }
}

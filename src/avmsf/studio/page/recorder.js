/** The microphone: a button that records one impact, with its level while it is recorded. */

import { fileUrl } from "./api.js";
import { encodeWav } from "./audio.js";
import { button, element, group, say, unsay, warning } from "./dom.js";

const MAX_SECONDS = 12;
const SECONDS_AFTER_IMPACT = 3;
const IMPACT_LEVEL = 0.05;
/** Seconds for which the greatest level is shown: an impact's own is over before anybody has read it. */
const HOLD_SECONDS = 1;
/** Reached by an input that is overdriven, and by no other. */
const CLIPPED_LEVEL = 0.999;
const REASONS = {
  NotAllowedError: "The browser blocks the microphone for this page. Allow it in the address bar, or drop a WAV file.",
  NotFoundError: "No microphone found. Connect one, or drop a WAV file.",
  NotReadableError: "Another program uses the microphone. Close it, or drop a WAV file.",
};

export class RecordButton {
  #recording = null;

  /** `done(blob)` is called with a recording, `changed()` whenever one begins or ends. */
  constructor({ done, changed = () => {}, main = false }) {
    Object.assign(this, { done, changed });
    this.button = button("● Record", () => this.#press(), { className: main ? "main" : "" });
    this.meter = element("meter", { min: 0, max: 1, high: 0.95, "aria-label": "Microphone level" });
    this.words = element("small");
    this.clipped = warning("Clipped: strike with less force.");
    Object.assign(this.clipped, { role: "alert", hidden: true });
    this.level = group(this.meter, this.words, this.clipped);
    prepare().catch(() => {});
  }

  get busy() {
    return this.#recording !== null;
  }

  async #press() {
    if (this.#recording) {
      if (!this.#recording.begun) this.words.textContent = "Stopped before the microphone was open.";
      this.#recording.stop();
      return;
    }
    unsay("microphone");
    this.#recording = new Recording((progress) => this.#showLevel(progress));
    this.words.textContent = "Opening the microphone …";
    this.clipped.hidden = true;
    this.#show();
    let blob = null;
    try {
      blob = await this.#recording.run();
    } catch (error) {
      this.words.textContent = "";
      say(error.message, { name: "microphone", bad: true });
    }
    this.#recording = null;
    this.#show();
    if (blob) await this.done(blob);
  }

  #show() {
    this.button.textContent = this.busy ? "■ Stop" : "● Record";
    this.button.classList.toggle("recording", this.busy);
    this.changed();
  }

  #showLevel({ level, seconds, detected, clipped }) {
    this.meter.value = level;
    this.words.textContent = `${seconds.toFixed(1)} s, ${detected ? "impact detected" : "waiting for the impact"}`;
    this.clipped.hidden = !clipped;
  }
}

/** One recording; `onLevel({level, seconds, detected, clipped})` is called during it, with the recent peak. */
class Recording {
  begun = false;
  #cancelled = false;
  #blocks = [];
  #seconds = 0;
  #impactAt = null;
  #held = { level: 0, since: 0 };
  #clipped = false;

  constructor(onLevel) {
    this.onLevel = onLevel;
    this.stopped = new Promise((resolve) => {
      this.stop = () => {
        this.#cancelled ||= !this.begun;
        resolve();
      };
    });
  }

  /** Record until `stop`, or until some seconds after an impact; gives the WAV, null if stopped before it had begun. */
  async run() {
    const opened = openMicrophone();
    // Whoever is asked for permission may take any time; the stop does not wait for it.
    const stream = await Promise.race([opened, this.stopped]);
    if (!stream) {
      opened.then(closeMicrophone, () => {});
      return null;
    }
    try {
      const context = await prepare();
      if (this.#cancelled) return null;
      // A microphone that is pulled out ends the recording; what came until then is kept.
      stream.getTracks().forEach((track) => track.addEventListener("ended", this.stop));
      this.begun = true;
      await listen(context, stream, (blocks) => this.#take(blocks, context.sampleRate), this.stopped);
      const samples = new Float32Array(await new Blob(this.#blocks).arrayBuffer());
      if (!samples.length) throw new Error("The microphone recorded nothing. Check that it is on, or drop a WAV file.");
      return encodeWav(samples, context.sampleRate);
    } finally {
      closeMicrophone(stream);
    }
  }

  #take(blocks, rate) {
    this.#blocks.push(...blocks);
    const values = blocks.flatMap((block) => [...block]);
    this.#seconds += values.length / rate;
    const peak = Math.max(...values.map(Math.abs));
    if (peak >= IMPACT_LEVEL) this.#impactAt ??= this.#seconds;
    this.#clipped ||= peak >= CLIPPED_LEVEL;
    if (peak >= this.#held.level || this.#seconds - this.#held.since >= HOLD_SECONDS)
      this.#held = { level: peak, since: this.#seconds };
    const detected = this.#impactAt !== null;
    this.onLevel({ level: this.#held.level, seconds: this.#seconds, detected, clipped: this.#clipped });
    const over = detected && this.#seconds - this.#impactAt >= SECONDS_AFTER_IMPACT;
    if (over || this.#seconds >= MAX_SECONDS) this.stop();
  }
}

async function openMicrophone() {
  if (!navigator.mediaDevices?.getUserMedia || typeof AudioWorkletNode === "undefined")
    throw new Error("This browser records only on pages from https or localhost: drop a WAV file.");
  try {
    // What makes speech pleasant falsifies an impact.
    const audio = { echoCancellation: false, noiseSuppression: false, autoGainControl: false, channelCount: 1 };
    return await navigator.mediaDevices.getUserMedia({ audio });
  } catch (error) {
    throw new Error(REASONS[error.name] ?? `The microphone cannot be used (${error.message}). Drop a WAV file.`);
  }
}

const closeMicrophone = (stream) => stream.getTracks().forEach((track) => track.stop());

let prepared = null;

/** Load what a recording needs while the server is there; the recording itself does without the server. */
function prepare() {
  prepared ??= openContext().catch((error) => {
    prepared = null;
    throw error;
  });
  return prepared;
}

async function openContext() {
  const context = new AudioContext();
  try {
    await context.audioWorklet.addModule(fileUrl("page/recorderprocessor.js"));
  } catch {
    context.close();
    throw new Error("The recorder could not be loaded. Check that `avmsf studio` runs, then record again.");
  }
  return context;
}

/** Call `take` with the blocks of a stream's sound, as they come, until `end`. */
async function listen(context, stream, take, end) {
  const node = new AudioWorkletNode(context, "avmsf-recorder", { numberOfOutputs: 0 });
  const source = context.createMediaStreamSource(stream);
  node.port.onmessage = ({ data }) => take(data);
  source.connect(node);
  context.resume().catch(() => {});
  await end;
  source.disconnect();
  node.port.postMessage("end");
}

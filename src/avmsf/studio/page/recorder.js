/** The microphone: record one blow, with its level to be seen meanwhile. */

import { encodeWav } from "./wav.js";

const LONGEST = 12;
const AFTER_BLOW = 3;
const BLOW_LEVEL = 0.05;
/** Seconds for which the greatest level is shown: a blow's own is over before anybody has read it. */
const HOLD = 1;
/** What an input that is driven too far gives, and nothing else comes this near to full scale. */
const CLIPPED_LEVEL = 0.999;

const REASONS = {
  NotAllowedError:
    "The browser blocks the microphone for this page. Allow it in the address bar, or drop a WAV file.",
  NotFoundError: "No microphone found. Connect one, or drop a WAV file.",
  NotReadableError: "Another program uses the microphone. Close it, or drop a WAV file.",
};

async function openMicrophone() {
  if (!navigator.mediaDevices?.getUserMedia || typeof AudioWorkletNode === "undefined") {
    throw new Error("This browser records only on pages from https or localhost: drop a WAV file.");
  }
  try {
    // What makes speech pleasant falsifies a blow.
    const audio = { echoCancellation: false, noiseSuppression: false, autoGainControl: false, channelCount: 1 };
    return await navigator.mediaDevices.getUserMedia({ audio });
  } catch (error) {
    const other = `The microphone cannot be used (${error.message}). Drop a WAV file.`;
    throw new Error(REASONS[error.name] ?? other);
  }
}

const closeMicrophone = (stream) => stream.getTracks().forEach((track) => track.stop());

let prepared = null;
let recordings = 0;

/** Make ready what a recording needs while the server is there; the recording itself does without the server. */
export function prepareRecorder() {
  prepared ??= openContext().catch((error) => {
    prepared = null;
    throw error;
  });
  return prepared;
}

async function openContext() {
  const context = new AudioContext();
  try {
    await context.audioWorklet.addModule(new URL("./recorderprocessor.js", import.meta.url));
  } catch {
    context.close();
    throw new Error(
      "The recorder could not be loaded from the server. Check that `avmsf studio` runs, then record again.",
    );
  }
  if (!recordings) context.suspend();
  return context;
}

/** Hand every block of a stream's sound to `take` while `meanwhile` lasts. */
async function listen(context, stream, take, meanwhile) {
  const node = new AudioWorkletNode(context, "avmsf-recorder", { numberOfOutputs: 0 });
  const source = context.createMediaStreamSource(stream);
  node.port.onmessage = ({ data }) => take(data);
  source.connect(node);
  recordings++;
  context.resume().catch(() => {});
  await meanwhile;
  recordings--;
  source.disconnect();
  node.port.postMessage("end");
  if (!recordings) context.suspend();
}

export class Recorder {
  #now = null;

  /** `onLevel({level, seconds, struck, clipped})` tells of the recording; level is the recent peak, full scale 1. */
  constructor(onLevel) {
    this.onLevel = onLevel;
  }

  /** What goes on: "idle", "opening" (the microphone, which may have to be allowed) or "recording". */
  get state() {
    return this.#now?.state ?? "idle";
  }

  /** Record until `stop`, or until some seconds after a blow; gives the WAV, null if stopped before it had begun. */
  async record() {
    const recording = new Recording(this.onLevel);
    this.#now = recording;
    try {
      return await recording.run();
    } finally {
      if (this.#now === recording) this.#now = null;
    }
  }

  stop() {
    this.#now?.stop();
  }
}

class Recording {
  state = "opening";
  #given = false;
  #blocks = [];
  #seconds = 0;
  #struckAt = null;
  #held = { level: 0, since: 0 };
  #clipped = false;

  constructor(onLevel) {
    this.onLevel = onLevel;
    this.stopped = new Promise((resolve) => {
      this.stop = () => {
        this.#given ||= this.state === "opening";
        resolve();
      };
    });
  }

  async run() {
    const opened = openMicrophone();
    // Whoever is asked for leave may take any time; the stop does not wait for it.
    const stream = await Promise.race([opened, this.stopped]);
    if (!stream) {
      opened.then(closeMicrophone, () => {});
      return null;
    }
    try {
      const context = await prepareRecorder();
      if (this.#given) return null;
      // A microphone that is pulled out ends the recording; what came until then is kept.
      stream.getTracks().forEach((track) => track.addEventListener("ended", this.stop));
      this.state = "recording";
      await listen(context, stream, (block) => this.#take(block, context.sampleRate), this.stopped);
      return this.#sound(context.sampleRate);
    } finally {
      closeMicrophone(stream);
    }
  }

  #take(block, rate) {
    this.#blocks.push(block);
    this.#seconds += block.length / rate;
    const peak = block.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
    if (this.#struckAt === null && peak >= BLOW_LEVEL) this.#struckAt = this.#seconds;
    this.#clipped ||= peak >= CLIPPED_LEVEL;
    if (peak >= this.#held.level || this.#seconds - this.#held.since >= HOLD)
      this.#held = { level: peak, since: this.#seconds };
    this.onLevel({
      level: this.#held.level,
      seconds: this.#seconds,
      struck: this.#struckAt !== null,
      clipped: this.#clipped,
    });
    const struckLongAgo = this.#struckAt !== null && this.#seconds - this.#struckAt >= AFTER_BLOW;
    if (struckLongAgo || this.#seconds >= LONGEST) this.stop();
  }

  #sound(sampleRate) {
    const samples = new Float32Array(this.#blocks.reduce((sum, block) => sum + block.length, 0));
    if (!samples.length) throw new Error("The microphone recorded no samples. Check that it is on, or drop a WAV file.");
    let at = 0;
    for (const block of this.#blocks) {
      samples.set(block, at);
      at += block.length;
    }
    return encodeWav(samples, sampleRate);
  }
}

/** The microphone: record one blow, with its level to be seen meanwhile. */

import { encodeWav } from "./wav.js";

const LONGEST = 12;
const AFTER_BLOW = 3;
const BEFORE_STOP_LEVEL = 0.05;

/** The microphone cannot be used; the message says why and what to do. */
export class MicrophoneError extends Error {}

const REASONS = {
  NotAllowedError:
    "The browser does not let this page use the microphone. Allow it in the address bar, or drop a WAV file instead.",
  NotFoundError: "There is no microphone here. Plug one in, or drop a WAV file instead.",
  NotReadableError: "Another program holds the microphone. Close it, or drop a WAV file instead.",
};

async function openMicrophone() {
  if (!navigator.mediaDevices?.getUserMedia || typeof AudioWorkletNode === "undefined") {
    throw new MicrophoneError("This browser cannot record here (it wants https or localhost): drop a WAV file.");
  }
  try {
    // What makes speech pleasant falsifies a blow.
    const audio = { echoCancellation: false, noiseSuppression: false, autoGainControl: false, channelCount: 1 };
    return await navigator.mediaDevices.getUserMedia({ audio });
  } catch (error) {
    const other = `The microphone cannot be used (${error.message}). Drop a WAV file instead.`;
    throw new MicrophoneError(REASONS[error.name] ?? other);
  }
}

export class Recorder {
  #blocks = [];
  #seconds = 0;
  #struckAt = null;
  #finish = null;

  /** `onLevel({peak, seconds, struck})` is called for every block, peak from 0 to 1, full scale. */
  constructor(onLevel) {
    this.onLevel = onLevel;
  }

  get recording() {
    return this.#finish !== null;
  }

  /** Record until `stop`, or until some seconds after a blow; gives {blob, samples, sampleRate}. */
  async record() {
    const stream = await openMicrophone();
    const context = new AudioContext();
    try {
      await context.audioWorklet.addModule(new URL("./recorderprocessor.js", import.meta.url));
      const node = new AudioWorkletNode(context, "avmsf-recorder", { numberOfOutputs: 0 });
      context.createMediaStreamSource(stream).connect(node);
      this.#blocks = [];
      this.#seconds = 0;
      this.#struckAt = null;
      await new Promise((finish) => {
        this.#finish = finish;
        node.port.onmessage = ({ data }) => this.#take(data, context.sampleRate);
        // A microphone that is pulled out ends the recording; what came until then is kept.
        stream.getTracks().forEach((track) => track.addEventListener("ended", finish));
      });
      const samples = new Float32Array(this.#blocks.reduce((sum, block) => sum + block.length, 0));
      let at = 0;
      for (const block of this.#blocks) {
        samples.set(block, at);
        at += block.length;
      }
      return { blob: encodeWav(samples, context.sampleRate), samples, sampleRate: context.sampleRate };
    } finally {
      this.#finish = null;
      stream.getTracks().forEach((track) => track.stop());
      await context.close();
    }
  }

  stop() {
    this.#finish?.();
  }

  #take(block, rate) {
    if (!this.#finish) return;
    this.#blocks.push(block);
    this.#seconds += block.length / rate;
    const peak = block.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
    if (this.#struckAt === null && peak >= BEFORE_STOP_LEVEL) this.#struckAt = this.#seconds;
    this.onLevel({ peak, seconds: this.#seconds, struck: this.#struckAt !== null });
    const struckLongAgo = this.#struckAt !== null && this.#seconds - this.#struckAt >= AFTER_BLOW;
    if (struckLongAgo || this.#seconds >= LONGEST) this.#finish();
  }
}

/** Hands the microphone's sound to the page, untouched, some fifty times a second. */

const BLOCK_SECONDS = 0.02;

class RecorderProcessor extends AudioWorkletProcessor {
  #length = Math.round(BLOCK_SECONDS * sampleRate);
  #block = new Float32Array(this.#length);
  #filled = 0;
  #ended = false;

  constructor() {
    super();
    this.port.onmessage = () => {
      this.#ended = true;
    };
  }

  process([[sound]]) {
    for (let at = 0; at < (sound?.length ?? 0); ) {
      const part = sound.subarray(at, at + this.#length - this.#filled);
      this.#block.set(part, this.#filled);
      this.#filled += part.length;
      at += part.length;
      if (this.#filled === this.#length) this.#send();
    }
    return !this.#ended;
  }

  #send() {
    this.port.postMessage(this.#block, [this.#block.buffer]);
    this.#block = new Float32Array(this.#length);
    this.#filled = 0;
  }
}

registerProcessor("avmsf-recorder", RecorderProcessor);

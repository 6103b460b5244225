/** Hands the microphone's sound to the page, untouched, some fifty times a second. */

/** Blocks of 128 samples in one message. */
const BLOCKS = 8;

class RecorderProcessor extends AudioWorkletProcessor {
  #blocks = [];
  #ended = false;

  constructor() {
    super();
    this.port.onmessage = () => {
      this.#ended = true;
    };
  }

  process([[block]]) {
    if (block) this.#blocks.push(block.slice());
    if (this.#blocks.length === BLOCKS) this.port.postMessage(this.#blocks.splice(0));
    return !this.#ended;
  }
}

registerProcessor("avmsf-recorder", RecorderProcessor);

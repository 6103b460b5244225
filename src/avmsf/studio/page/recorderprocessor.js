/** Hands every block of the microphone to the page, untouched. */

class RecorderProcessor extends AudioWorkletProcessor {
  process([input]) {
    if (input[0]) this.port.postMessage(input[0].slice());
    return true;
  }
}

registerProcessor("avmsf-recorder", RecorderProcessor);

/** Sounds as WAV files and as samples: written, checked, decoded, drawn, played, taken to another sample rate. */

/** One channel of 32-bit floats, so that nothing is rounded or cut off on the way. */
export function encodeWav(samples, sampleRate) {
  const bytes = new ArrayBuffer(58 + 4 * samples.length);
  const view = new DataView(bytes);
  const write = (at, letters) => [...letters].forEach((letter, place) => view.setUint8(at + place, letter.charCodeAt(0)));
  write(0, "RIFF");
  view.setUint32(4, bytes.byteLength - 8, true);
  write(8, "WAVEfmt ");
  view.setUint32(16, 18, true);
  view.setUint16(20, 3, true);
  view.setUint16(22, 1, true);
  view.setUint32(24, sampleRate, true);
  view.setUint32(28, 4 * sampleRate, true);
  view.setUint16(32, 4, true);
  view.setUint16(34, 32, true);
  view.setUint16(36, 0, true);
  // Formats other than integers state their number of samples as well.
  write(38, "fact");
  view.setUint32(42, 4, true);
  view.setUint32(46, samples.length, true);
  write(50, "data");
  view.setUint32(54, 4 * samples.length, true);
  samples.forEach((value, place) => view.setFloat32(58 + 4 * place, value, true));
  return new Blob([bytes], { type: "audio/wav" });
}

/** Throw what to say of a file that does not begin as a WAV does; the server looks closer. */
export async function expectWav(file) {
  const letters = String.fromCharCode(...new Uint8Array(await file.slice(0, 12).arrayBuffer()));
  if (letters.startsWith("RIFF") && letters.endsWith("WAVE")) return;
  throw new Error(`${file.name}: expected a WAV file, got another kind; save the sound as WAV and choose it again.`);
}

/** An audio file as a buffer at a sample rate, to which the browser takes it. */
export function decode(bytes, sampleRate) {
  return new OfflineAudioContext(1, 1, sampleRate).decodeAudioData(bytes);
}

/** Samples of rate `from` at rate `to`. */
export async function resample(samples, from, to) {
  if (from === to || !samples.length) return samples;
  const bytes = await encodeWav(samples, Math.round(from)).arrayBuffer();
  return (await decode(bytes, to)).getChannelData(0);
}

/** Draw a recording's envelope into a canvas, and a line at its onset. */
export async function drawWaveform(canvas, blob, onset) {
  const buffer = await decode(await blob.arrayBuffer(), 48000);
  const samples = buffer.getChannelData(0);
  const context = canvas.getContext("2d");
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.round(size * devicePixelRatio));
  [canvas.width, canvas.height] = [width, height];
  const style = getComputedStyle(canvas);
  context.fillStyle = style.getPropertyValue("--second");
  const peak = samples.reduce((most, value) => Math.max(most, Math.abs(value)), 1e-9);
  const y = (value) => (height / 2) * (1 - (0.95 * value) / peak);
  for (let x = 0; x < width; x++) {
    const part = samples.subarray(Math.floor((x * samples.length) / width), ((x + 1) * samples.length) / width);
    const low = part.reduce((least, value) => Math.min(least, value), 0);
    const high = part.reduce((most, value) => Math.max(most, value), 0);
    context.fillRect(x, y(high), 1, Math.max(1, y(low) - y(high)));
  }
  if (onset === null) return;
  context.fillStyle = style.getPropertyValue("--first");
  context.fillRect((onset * width) / buffer.duration, 0, 2 * devicePixelRatio, height);
}

let playing = null;

/** Play a recording, a blob or an address, by the browser's own player; one recording at a time. */
export async function listen(sound) {
  playing?.end();
  const address = sound instanceof Blob ? URL.createObjectURL(sound) : sound;
  const player = new Audio(address);
  const mine = {
    end() {
      player.pause();
      if (address !== sound) URL.revokeObjectURL(address);
      if (playing === mine) playing = null;
    },
  };
  playing = mine;
  player.addEventListener("ended", mine.end);
  try {
    await player.play();
  } catch (error) {
    // Another was begun before this one was read.
    if (playing !== mine) return;
    mine.end();
    throw new Error(`The recording cannot be played (${error.message}).`);
  }
}

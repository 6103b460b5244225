/** Sounds as WAV files and as samples: written, decoded, drawn, played, taken to another sample rate. */

/** Four letters as the little-endian number that they are in a file. */
const word = (letters) => [...letters].reduceRight((number, letter) => 256 * number + letter.charCodeAt(0), 0);

/** A WAV file of Float32Array samples: one channel of floats, so that nothing is rounded or cut off on the way. */
export function encodeWav(samples, sampleRate) {
  const size = 4 * samples.length;
  // Kind 3, floats, in 1 channel; 4 bytes a frame, 32 bits a sample. Floats state their length twice.
  const format = [word("fmt "), 16, 0x00010003, sampleRate, 4 * sampleRate, 0x00200004];
  const fact = [word("fact"), 4, samples.length];
  const head = [word("RIFF"), 48 + size, word("WAVE"), ...format, ...fact, word("data"), size];
  return new Blob([Uint32Array.from(head), samples], { type: "audio/wav" });
}

/** An audio file as a buffer at a sample rate, to which the browser takes it. */
export function decode(bytes, sampleRate) {
  return new OfflineAudioContext(1, 1, sampleRate).decodeAudioData(bytes);
}

/** Samples of rate `from` at rate `to`. */
export async function resample(samples, from, to) {
  if (from === to || !samples.length) return samples;
  // Browsers read no file of such a rate.
  if (from < 3000 || from > 768000)
    return Float32Array.from({ length: Math.ceil((samples.length * to) / from) }, (_, at) => {
      const place = (at * from) / to, before = Math.floor(place), after = Math.min(before + 1, samples.length - 1);
      return samples[before] + (place - before) * (samples[after] - samples[before]);
    });
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

const player = new Audio();
player.addEventListener("ended", () => URL.revokeObjectURL(player.src));

/** Play a recording, a blob or an address, by the browser's own player; one recording at a time. */
export async function listen(sound) {
  URL.revokeObjectURL(player.src);
  player.src = sound instanceof Blob ? URL.createObjectURL(sound) : sound;
  await player.play().catch((error) => {
    // Another was begun before this one was read.
    if (error.name !== "AbortError") throw new Error(`The recording cannot be played (${error.message}).`);
  });
}

/** The spectrum of a whole sound. */

/** Level in dB at `count` pitches, evenly spaced to the ear from `low` to `high` Hz: the loudest line about each. */
export function soundSpectrum(samples, sampleRate, { low, high, count }) {
  const size = 2 ** Math.ceil(Math.log2(Math.max(samples.length, 2)));
  const real = new Float64Array(size);
  const imaginary = new Float64Array(size);
  real.set(samples);
  transform(real, imaginary);
  const levels = new Float32Array(count).fill(-Infinity);
  for (let line = 1; line < size / 2; line++) {
    const frequency = (line * sampleRate) / size;
    const place = Math.floor((count * Math.log(frequency / low)) / Math.log(high / low));
    if (place < 0 || place >= count) continue;
    const level = 10 * Math.log10(real[line] ** 2 + imaginary[line] ** 2 + 1e-20);
    if (level > levels[place]) levels[place] = level;
  }
  // Low down there are fewer lines than places.
  for (let place = 1; place < count; place++) if (levels[place] === -Infinity) levels[place] = levels[place - 1];
  return levels;
}

/** Fourier's transform in place, for lengths that are powers of two. */
export function transform(real, imaginary) {
  const size = real.length;
  for (let place = 1, mirror = 0; place < size; place++) {
    let bit = size >> 1;
    for (; mirror & bit; bit >>= 1) mirror ^= bit;
    mirror ^= bit;
    if (place < mirror) {
      [real[place], real[mirror]] = [real[mirror], real[place]];
      [imaginary[place], imaginary[mirror]] = [imaginary[mirror], imaginary[place]];
    }
  }
  for (let length = 2; length <= size; length *= 2) {
    const half = length / 2;
    const cosines = Float64Array.from({ length: half }, (_, step) => Math.cos((2 * Math.PI * step) / length));
    const sines = Float64Array.from({ length: half }, (_, step) => -Math.sin((2 * Math.PI * step) / length));
    for (let start = 0; start < size; start += length)
      for (let step = 0; step < half; step++) {
        const [one, other] = [start + step, start + step + half];
        const re = real[other] * cosines[step] - imaginary[other] * sines[step];
        const im = real[other] * sines[step] + imaginary[other] * cosines[step];
        real[other] = real[one] - re;
        imaginary[other] = imaginary[one] - im;
        real[one] += re;
        imaginary[one] += im;
      }
  }
}

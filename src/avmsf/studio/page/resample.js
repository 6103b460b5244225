// Sound at another sample rate, by a windowed sinc.

/** Zero crossings of the sinc on either side. */
const CROSSINGS = 24;

/** Return `samples` of rate `from` as they are at rate `to`, whole Hz; what lies above half of either is left out. */
export function resample(samples, from, to) {
  if (from === to) return samples;
  const common = greatestDivisor(Math.round(from), Math.round(to));
  const step = Math.round(from) / common, phases = Math.round(to) / common;
  const { reach, width, weights } = sincs(phases, Math.min(1, phases / step));
  const out = new Float32Array(Math.max(1, Math.round((samples.length * phases) / step)));
  for (let n = 0; n < out.length; n++) {
    const whole = Math.floor((n * step) / phases), phase = n * step - whole * phases;
    const first = Math.max(0, whole - reach), last = Math.min(samples.length - 1, whole + reach + 1);
    const start = phase * width - whole + reach;
    let sum = 0;
    for (let k = first; k <= last; k++) sum += samples[k] * weights[start + k];
    out[n] = sum;
  }
  return out;
}

/** The weights of the neighbors of each of the places between two samples that are asked for, in turn. */
function sincs(phases, cut) {
  const reach = Math.ceil(CROSSINGS / cut), width = 2 * reach + 2;
  const weights = new Float64Array(phases * width);
  for (let phase = 0; phase < phases; phase++) {
    for (let tap = 0; tap < width; tap++) {
      const x = (tap - reach - phase / phases) * cut;
      if (Math.abs(x) >= CROSSINGS) continue;
      const sinc = Math.abs(x) < 1e-9 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x);
      weights[phase * width + tap] = cut * sinc * (0.5 + 0.5 * Math.cos((Math.PI * x) / CROSSINGS));
    }
  }
  return { reach, width, weights };
}

function greatestDivisor(one, other) {
  while (other) [one, other] = [other, one % other];
  return one;
}

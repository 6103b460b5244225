// The force of a blow over its contact time, as avmsf.modal.modes has it: unit impulse, half sine or its power 3/2.

const EXPONENTS = { "half-sine": 1, hertz: 1.5 };
// Gauss and Legendre's five points on -1..1.
const NODES = [0, 0.5384693101056831, -0.5384693101056831, 0.906179845938664, -0.906179845938664];
const WEIGHTS = [0.5688888888888889, 0.47862867049936647, 0.47862867049936647, 0.23692688505618908, 0.23692688505618908];
const PANELS = 4;

/** Return the part of the impulse that falls into each sample's time; their sum is 1. `contactTime` in seconds. */
export function pulseSamples(contactTime, sampleRate, shape = "half-sine") {
  const exponent = EXPONENTS[shape];
  if (exponent === undefined) throw new RangeError(`pulse: expected half-sine or hertz, got ${shape}`);
  if (!(contactTime >= 0 && contactTime < 10)) throw new RangeError(`contact time: expected 0 to 10 s, got ${contactTime}`);
  const length = contactTime * sampleRate;
  const count = Math.max(1, Math.ceil(length));
  if (count === 1) return Float64Array.of(1);
  const parts = new Float64Array(count);
  let sum = 0;
  for (let n = 0; n < count; n++) sum += parts[n] = impulse(n / length, Math.min(1, (n + 1) / length), exponent);
  return parts.map((part) => part / sum);
}

/**
 * How far a mode swings at a pulse's last sample, over what an impulse there would leave; `angle` and `decay` are the
 * radians by which it turns and the nepers by which it falls from one sample to the next.
 */
export function swingAfter(pulse, angle, decay = 0) {
  const radius = Math.exp(-decay);
  const [turnRe, turnIm] = [radius * Math.cos(angle), radius * Math.sin(angle)];
  let [re, im] = [0, 0];
  for (const part of pulse) [re, im] = [turnRe * re - turnIm * im + part, turnRe * im + turnIm * re];
  return Math.hypot(re, im);
}

/** Integrate sin(pi t)^exponent, in u with t = (1 - cos u) / 2, in which both ends are smooth. */
function impulse(from, to, exponent) {
  const start = Math.acos(1 - 2 * from), width = (Math.acos(1 - 2 * to) - start) / PANELS;
  let sum = 0;
  for (let panel = 0; panel < PANELS; panel++) {
    for (let node = 0; node < NODES.length; node++) {
      const u = start + width * (panel + 0.5 + NODES[node] / 2);
      const force = Math.sin((Math.PI * (1 - Math.cos(u))) / 2);
      sum += WEIGHTS[node] * width * Math.max(0, force) ** exponent * Math.sin(u);
    }
  }
  return sum;
}

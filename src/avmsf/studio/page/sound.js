// The sound engine: impacts on the field's points, heard through the modal bank on the audio thread.

import { fileUrl } from "./api.js";
import { resample } from "./audio.js";
import { Bank } from "./bank.js";

const PROCESSOR = "avmsf-modal-bank";
/** Impacts that may sound at once; with dampings shared by all contacts this bounds their noise alone. */
const VOICES = 64;
/** Peak that the loudest contact's impact of force 1 is brought to, over full scale. */
const COMFORTABLE = 0.5;
/** Seconds by which the live limiter knows what is to come; all that is heard is late by as much. */
const AHEAD = 0.0015;
/** Seconds after an impact until it is said that the browser holds the sound back. */
const PATIENCE = 1;
/** Contacts, and seconds of their sound, that the loudest is sought among. */
const LOUD_CONTACTS = 8, LOUD_SECONDS = 0.03;

/** Exponents of the sine that a mallet's force follows over its contact time, as avmsf.modal.modes has it. */
const EXPONENTS = { "half-sine": 1, hertz: 1.5 };
/** Gauss and Legendre's five points on -1..1. */
const [INNER, OUTER] = [0.5384693101056831, 0.906179845938664];
const NODES = [-OUTER, -INNER, 0, INNER, OUTER];
const [EDGE, BETWEEN] = [0.23692688505618908, 0.47862867049936647];
const WEIGHTS = [EDGE, BETWEEN, 0.5688888888888889, BETWEEN, EDGE];
const PANELS = 4;

/** The part of the impulse that falls into each sample's time; their sum is 1. `contactTime` in seconds. */
export function pulseSamples(contactTime, sampleRate, shape = "half-sine") {
  const exponent = EXPONENTS[shape];
  if (exponent === undefined) throw new RangeError(`pulse: expected half-sine or hertz, got ${shape}`);
  if (!(contactTime >= 0 && contactTime < 10))
    throw new RangeError(`contact time: expected 0 to 10 s, got ${contactTime}`);
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

/** What a field is at one sample rate, and the impacts on it as the bank wants them. */
class Tuned {
  static async of({ manifest, tensors }, rate) {
    return new Tuned(manifest, tensors, rate, await resample(tensors.noise, manifest.sampleRate, rate));
  }

  constructor(manifest, tensors, rate, noise) {
    this.rate = rate;
    this.tensors = tensors;
    this.modes = manifest.modes;
    this.points = manifest.points;
    this.kept = [...tensors.frequency.keys()].filter((mode) => tensors.frequency[mode] < rate / 2);
    this.shared = manifest.damping === "shared";
    /** Whether the noise is background, as loud under any force. */
    this.steady = Boolean(manifest.backgroundForce);
    this.frequency = this.pick(tensors.frequency, 0);
    const damping = this.shared ? this.pick(tensors.damping, 0) : null;
    this.field = { frequency: this.frequency, damping, noise };
  }

  pick(tensor, row) {
    return Float64Array.from(this.kept, (mode) => tensor[row * this.modes + mode]);
  }

  impact(row, { force = 1, contactTime = 0, shape = "half-sine" }, frame = 0) {
    if (!(Number.isInteger(row) && row >= 0 && row < this.points))
      throw new RangeError(`contact: expected 0 to ${this.points - 1}, got ${row}`);
    if (!Number.isFinite(force)) throw new RangeError(`force: expected a number, got ${force}`);
    const sine = this.pick(this.tensors.sine, row), cosine = this.pick(this.tensors.cosine, row);
    const pulse = pulseSamples(contactTime, this.rate, shape);
    let loudest = 0;
    for (let mode = 0; mode < sine.length; mode++) {
      const passed = swingAfter(pulse, (2 * Math.PI * this.frequency[mode]) / this.rate);
      loudest = Math.max(loudest, Math.hypot(sine[mode], cosine[mode]) * passed * Math.abs(force));
    }
    const damping = this.shared ? null : this.pick(this.tensors.damping, row);
    const noise = this.steady ? 1 : force;
    return { frame, sine, cosine, damping, force: pulse.map((part) => part * force), strength: force, noise, loudest };
  }

  /** The largest that a sample of an impact of force 1 can be. */
  bound(row) {
    let sum = this.noisePeak ??= this.field.noise.reduce((peak, value) => Math.max(peak, Math.abs(value)), 0);
    for (const mode of this.kept) {
      const place = row * this.modes + mode;
      // Math.hypot is tenfold slower, and this runs for every contact before the page can sound.
      sum += Math.sqrt(this.tensors.sine[place] ** 2 + this.tensors.cosine[place] ** 2);
    }
    return sum;
  }

  /** The peak of the loudest contacts' sound, at force 1. */
  loudest() {
    const bounds = Array.from({ length: this.points }, (_, row) => [this.bound(row), row]);
    const rows = bounds.sort((one, other) => other[0] - one[0]).slice(0, LOUD_CONTACTS);
    return rows.reduce((peak, [, row]) => Math.max(peak, this.peak(row)), 0);
  }

  peak(row) {
    const sound = new Float64Array(Math.ceil(LOUD_SECONDS * this.rate));
    const bank = new Bank({ ...this.field, noise: Float32Array.of(0) }, this.rate, sound.length, 1);
    bank.strike(this.impact(row, {}));
    bank.render(sound, 0);
    return sound.reduce((peak, value) => Math.max(peak, Math.abs(value)), 0);
  }
}

function bankNode(context, tuned, { level, voices = VOICES, impacts = [], ahead = 0 }) {
  const processorOptions = { field: tuned.field, level, voices, impacts, ahead };
  return new AudioWorkletNode(context, PROCESSOR, {
    numberOfInputs: 1, numberOfOutputs: 1, outputChannelCount: [1],
    channelCount: 1, channelCountMode: "explicit", channelInterpretation: "speakers", processorOptions,
  });
}

async function addBank(context) {
  if (context.audioWorklet === undefined)
    throw new Error("this browser has no AudioWorklet: open the page from https or localhost in a current browser");
  await context.audioWorklet.addModule(fileUrl("page/bank.js"));
}

/**
 * The sound of impacts, [{row, force, contactTime, shape, when}] with `when` in seconds, from the bank that also plays
 * live: at the field's own rate or another, as long as a training sound or `seconds`, in the field's unit.
 */
export async function renderOffline(bundle, impacts, seconds, options = {}) {
  const { manifest } = bundle;
  const { sampleRate = manifest.sampleRate, voices } = options;
  const length = seconds ?? manifest.samples / manifest.sampleRate;
  const samples = Math.round(length * sampleRate);
  const context = new OfflineAudioContext(1, Math.max(1, samples), sampleRate);
  await addBank(context);
  const tuned = await Tuned.of(bundle, context.sampleRate);
  const frame = ({ when = 0 }) => Math.round(when * sampleRate);
  const ready = impacts.map((impact) => tuned.impact(impact.row, impact, frame(impact)));
  // So low that the limiter has nothing to do, whatever the unit; a power of two rounds nothing.
  const bound = impacts.reduce((sum, { row, force = 1 }) => sum + Math.max(1, Math.abs(force)) * tuned.bound(row), 0);
  const level = bound > 0 ? 2 ** -Math.ceil(Math.log2(2 * bound)) : 1;
  bankNode(context, tuned, { level, impacts: ready, voices }).connect(context.destination);
  const sound = (await context.startRendering()).getChannelData(0);
  return sound.map((value) => value / level);
}

/** Impacts heard live. */
export class SoundEngine {
  /** An engine; before the first touch of the page, browsers hold its sound back. Throws where there is no sound. */
  static async start(bundle, { context } = {}) {
    if (typeof AudioContext === "undefined") throw new Error("this browser has no AudioContext");
    const used = context ?? new AudioContext({ latencyHint: "interactive" });
    await addBank(used);
    return new SoundEngine(bundle, used, await Tuned.of(bundle, used.sampleRate));
  }

  constructor(bundle, context, tuned) {
    this.bundle = bundle;
    this.context = context;
    this.tuned = tuned;
    this.volume = 1;
    this.comfortable = COMFORTABLE / (this.tuned.loudest() || 1);
    const ahead = Math.round(AHEAD * context.sampleRate);
    this.node = bankNode(context, this.tuned, { level: this.comfortable, ahead });
    this.analyser = new AnalyserNode(context, { fftSize: 8192, smoothingTimeConstant: 0 });
    this.node.connect(this.analyser).connect(context.destination);
    /** Called with {time}, the context's seconds, of an impact's first sample when it begins. */
    this.onbegin = null;
    /** Called with true once what sounds has to be turned down to fit, and with false when it fits again. */
    this.onlimited = null;
    /** Called with true when the browser holds the sound back after an impact, and with false when it plays. */
    this.onheld = null;
    this.node.port.onmessage = ({ data: { type, frame, limited } }) => {
      if (type === "begun") this.onbegin?.({ time: frame / context.sampleRate });
      if (type === "limited") this.onlimited?.(limited);
    };
    context.addEventListener("statechange", () => {
      if (context.state === "running") this.onheld?.(false);
    });
  }

  /** What samples are multiplied by on their way out: the volume, over the loudest contact's peak. */
  get level() {
    return this.volume * this.comfortable;
  }

  setVolume(volume) {
    this.volume = volume;
    this.node.port.postMessage({ type: "level", level: this.level });
  }

  /** Strike a contact by its row; `force` over an average impact's, `contactTime` in seconds, 0 as recorded. */
  strike(row, { force = 1, contactTime = 0, shape = "half-sine" } = {}) {
    this.node.port.postMessage({ type: "strike", impact: this.tuned.impact(row, { force, contactTime, shape }) });
    this.wake();
  }

  /** Have the sound go on: browsers hold it back before the first touch, after a call and in the background. */
  wake() {
    const { context } = this;
    if (context.state === "running" || context.state === "closed") return;
    // Refused, it is still held, which is what is looked at.
    context.resume().catch(() => {});
    clearTimeout(this.waking);
    this.waking = setTimeout(() => {
      if (context.state !== "running" && context.state !== "closed") this.onheld?.(true);
    }, 1000 * PATIENCE);
  }

  /** Go on with another field, such as an edited one; what sounds fades. The level stays, to compare edits. */
  async replace(bundle) {
    this.tuned = await Tuned.of(bundle, this.context.sampleRate);
    this.bundle = bundle;
    this.node.port.postMessage({ type: "field", field: this.tuned.field });
  }

  /** Play a recording in the field's unit, at the level of the impacts; returns its source, which `stop` ends. */
  play(buffer) {
    const source = new AudioBufferSourceNode(this.context, { buffer });
    source.connect(this.node);
    source.start();
    this.wake();
    return source;
  }

  async close() {
    clearTimeout(this.waking);
    this.node.disconnect();
    await this.context.close();
  }
}

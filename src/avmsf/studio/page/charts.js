/** Spectrum and decay of what sounds, drawn while it sounds; two spectra over each other to compare. */

import { Chart } from "./chart.js";
import { say, unsay } from "./dom.js";
import { decibels } from "./modes.js";
import { pulseSamples, swingAfter } from "./sound.js";

const LOW_HZ = 40;
const HIGH_HZ = 20000;
const RANGE_DB = 80;
const DECIBELS_PER_NEPER = decibels(Math.E);
/** Pitches at which spectra are compared, evenly spaced to the ear. */
const COMPARED_PITCHES = 400;
/** What a Blackman window and the halves of a real spectrum take from a sine's level in the browser's analyser. */
const ANALYSER_DB = 20 * Math.log10(2 / 0.42);
/** Samples from which the level of a moment is taken: the long window of the spectrum would blur the decay. */
const LEVEL_SAMPLES = 1024;
const QUIET_SECONDS = 0.6;
/** Seconds between two levels from which on no line is drawn from one to the other. */
const GAP_SECONDS = 0.05;
/** Seconds for which the word that a sound was turned down stays to be read. */
const LIMITED_SECONDS = 2;
const HELD = "The browser blocks the sound: click anywhere on the page, or close programs that use the loudspeaker.";
const TICKS_HZ = [100, 1000, 10000];

const across = (frequency) => Math.log(frequency / LOW_HZ) / Math.log(HIGH_HZ / LOW_HZ);
const hertz = (frequency) => (frequency >= 1000 ? `${frequency / 1000} kHz` : `${frequency} Hz`);
const levelTicks = (top) =>
  [0, 0.25, 0.5, 0.75, 1].map((share) => ({ share, words: `${Math.round(top - share * RANGE_DB)}` }));

export class SpectrumView {
  #strike = null;
  /** Pieces of [seconds, level] each, between which no level was taken for too long. */
  #trace = [];
  #quietSince = null;
  #running = false;
  /** The spectra that are shown over each other, {recording, model}, dB; null while what sounds is shown. */
  compared = null;

  constructor(spectrumCanvas, decayCanvas) {
    this.spectrum = new Chart(spectrumCanvas);
    this.decay = new Chart(decayCanvas);
    this.modes = null;
    this.engine = null;
    new ResizeObserver(() => this.#running || this.#draw()).observe(spectrumCanvas);
  }

  /** Show another field's modes, and the engine's sound, or null without sound. The last strike stays drawn. */
  listen(modes, engine) {
    const strike = modes.contacts.equal(this.modes?.contacts) ? this.#strike : null;
    this.modes = modes;
    this.engine = engine;
    if (engine) {
      engine.onlimited = showLimited;
      engine.onheld = (held) => (held ? say(HELD, { name: "held", bad: true }) : unsay("held"));
    }
    this.compared = null;
    this.#strike = strike && this.#strikeOf(strike);
    this.#draw();
  }

  /** A strike of a contact sounds from now on: the model's, or a recording; the mallet as the engine has it. */
  struck(row, force, { contactTime = 0, shape = "half-sine" } = {}) {
    this.#strike = this.#strikeOf({ row, force, contactTime, shape, at: performance.now() });
    this.compared = null;
    this.#trace = [];
    this.#quietSince = null;
    if (this.#running) return;
    this.#running = true;
    const step = () => {
      this.#running = this.#measure();
      this.#draw();
      if (this.#running) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  /** A strike with what is drawn of it: from when the mallet leaves the object, `free`, ms. */
  #strikeOf({ row, force, contactTime, shape, at }) {
    const { modes } = this;
    const rate = modes.sampleRate;
    const pulse = pulseSamples(contactTime, rate, shape);
    const stems = Array.from({ length: modes.count }, (_, mode) => {
      const [frequency, damping] = [modes.frequency(mode), modes.damping(mode, row)];
      const left = swingAfter(pulse, (2 * Math.PI * frequency) / rate, damping / rate);
      return { frequency, level: decibels(force * modes.amplitude(mode, row) * left), damping };
    });
    const loudest = Math.max(...stems.map(({ level }) => level));
    // Long enough for the modes' sound to fall by the range of the chart, or most of it.
    const falls = stems.map(({ level, damping }) => (level - loudest + RANGE_DB) / (DECIBELS_PER_NEPER * damping));
    const seconds = Math.min(Math.max(...falls, 0.1), 6);
    const top = Math.ceil((loudest + 6) / 10) * 10;
    return { row, force, contactTime, shape, at, free: at + 1000 * contactTime, stems, top, seconds };
  }

  /** Show the spectra of two sounds, {samples, sampleRate} each, over each other. */
  compare(recording, model) {
    this.compared = { recording: soundSpectrum(recording), model: soundSpectrum(model) };
    this.#draw();
  }

  get #top() {
    return this.#strike?.top ?? 0;
  }

  get #secondsSinceStrike() {
    return this.#strike ? (performance.now() - this.#strike.free) / 1000 : 0;
  }

  /** Decibels by which the engine makes everything louder or softer than the field has it. */
  get #volume() {
    return decibels(this.engine?.level ?? 1);
  }

  /** Take down the level of this moment; returns whether anything is to come. */
  #measure() {
    const seconds = this.#secondsSinceStrike;
    const span = this.#strike?.seconds ?? 0;
    const analyser = this.engine?.analyser;
    if (!analyser) return seconds < span;
    this.wave ??= new Float32Array(analyser.fftSize);
    this.lines ??= new Float32Array(analyser.frequencyBinCount);
    analyser.getFloatTimeDomainData(this.wave);
    analyser.getFloatFrequencyData(this.lines);
    const power = this.wave.subarray(-LEVEL_SAMPLES).reduce((sum, value) => sum + value * value, 0) / LEVEL_SAMPLES;
    const level = decibels(Math.sqrt(power)) - this.#volume;
    if (!(seconds - this.#trace.at(-1)?.at(-1)[0] <= GAP_SECONDS)) this.#trace.push([]);
    this.#trace.at(-1).push([seconds, level]);
    if (level > this.#top - RANGE_DB - 10) this.#quietSince = null;
    else this.#quietSince ??= seconds;
    return this.#quietSince === null || seconds - this.#quietSince < QUIET_SECONDS || seconds < Math.min(span, 1);
  }

  #draw() {
    this.#drawSpectrum();
    this.#drawDecay();
  }

  #drawSpectrum() {
    const { spectrum: chart, compared } = this;
    chart.begin();
    const top = compared ? 0 : this.#top;
    const down = (level) => (top - level) / RANGE_DB;
    chart.axes(
      TICKS_HZ.map((frequency) => ({ share: across(frequency), words: hertz(frequency) })),
      levelTicks(top),
    );
    if (compared) {
      for (const [levels, color] of [
        [compared.recording, chart.ink.second],
        [compared.model, chart.ink.first],
      ]) {
        const loudest = Math.max(...levels);
        chart.curve(Array.from(levels, (level, at) => [at / (levels.length - 1), down(level - loudest)]), color);
      }
      return;
    }
    const fall = DECIBELS_PER_NEPER * this.#secondsSinceStrike;
    for (const { frequency, level, damping } of this.#strike?.stems ?? []) {
      if (frequency < LOW_HZ || frequency > HIGH_HZ) continue;
      // The level at the strike stays to be seen, faintly.
      for (const [height, color, width] of [
        [level, chart.ink.faint, 1],
        [level - damping * fall, chart.ink.first, 2],
      ]) {
        const share = across(frequency);
        if (height >= top - RANGE_DB) chart.curve([[share, 1], [share, down(height)]], color, { width });
      }
    }
    const analyser = this.engine?.analyser;
    if (!analyser || !this.lines || !this.#running) return;
    const { context, fftSize } = analyser;
    const step = context.sampleRate / fftSize;
    const shares = [];
    for (let line = Math.ceil(LOW_HZ / step); line < this.lines.length && line * step <= HIGH_HZ; line++)
      shares.push([across(line * step), down(Math.max(this.lines[line] + ANALYSER_DB - this.#volume, -1000))]);
    if (shares.length) chart.curve(shares, chart.ink.second, { width: 1.2, fill: true });
  }

  #drawDecay() {
    const { decay: chart } = this;
    chart.begin();
    const { seconds, stems } = this.#strike ?? { seconds: 1, stems: [] };
    const down = (level) => (this.#top - level) / RANGE_DB;
    const shares = chart.width < 240 ? [0.5, 1] : [0.25, 0.5, 0.75, 1];
    const ticks = shares.map((share) => ({ share, words: `${Number((share * seconds).toPrecision(2))} s` }));
    chart.axes(ticks, levelTicks(this.#top));
    for (const piece of this.#trace) {
      const points = piece.map(([at, level]) => [at / seconds, down(level)]);
      chart.curve(points, chart.ink.second, { fill: true });
    }
    if (!stems.length) return;
    const power = (at) =>
      stems.reduce((sum, { level, damping }) => sum + 0.5 * 10 ** (level / 10) * Math.exp(-2 * damping * at), 1e-30);
    const steps = Array.from({ length: 101 }, (_, step) => step / 100);
    const model = steps.map((share) => [share, down(10 * Math.log10(power(share * seconds)))]);
    chart.curve(model, chart.ink.first, { dash: [5, 4] });
  }
}

let forgetting;

function showLimited(limited) {
  const word = document.getElementById("limited");
  clearTimeout(forgetting);
  if (limited) word.hidden = false;
  else forgetting = setTimeout(() => (word.hidden = true), 1000 * LIMITED_SECONDS);
}

/** Level in dB at `COMPARED_PITCHES` from LOW_HZ to HIGH_HZ: the loudest line of the spectrum about each. */
function soundSpectrum({ samples, sampleRate }) {
  const size = 2 ** Math.ceil(Math.log2(Math.max(samples.length, 2)));
  const [real, imaginary] = [new Float64Array(size), new Float64Array(size)];
  real.set(samples);
  transform(real, imaginary);
  const levels = new Float32Array(COMPARED_PITCHES).fill(-Infinity);
  for (let line = 1; line < size / 2; line++) {
    const at = Math.floor(COMPARED_PITCHES * across((line * sampleRate) / size));
    const level = 10 * Math.log10(real[line] ** 2 + imaginary[line] ** 2 + 1e-20);
    if (at >= 0 && at < COMPARED_PITCHES) levels[at] = Math.max(levels[at], level);
  }
  // At low pitches there are fewer lines than pitches.
  for (let at = 1; at < COMPARED_PITCHES; at++) if (levels[at] === -Infinity) levels[at] = levels[at - 1];
  return levels;
}

/** Fourier's transform in place, for lengths that are powers of two. */
function transform(real, imaginary) {
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

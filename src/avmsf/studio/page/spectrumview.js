/** Spectrum and decay of what sounds, drawn while it sounds; two spectra side by side to compare. */

import { Chart } from "./chart.js";
import { say, unsay } from "./dom.js";
import { decibels } from "./modes.js";
import { pulseSamples, swingAfter } from "./pulse.js";

const LOW = 40;
const HIGH = 20000;
const RANGE_DB = 80;
/** What a Blackman window and the halves of a real spectrum take from a sine's level in the browser's analyser. */
const ANALYSER_DB = 20 * Math.log10(2 / 0.42);
const QUIET_SECONDS = 0.6;
/** Seconds between two looks at what is heard from which on no line is drawn from one to the other. */
const GAP_SECONDS = 0.05;
/** Seconds for which the word that a sound was turned down stays to be read. */
const LIMITED_SECONDS = 2;
const HELD = "The browser blocks the sound: click anywhere on the page, or close other programs that use the loudspeaker.";
const LABELLED = [100, 1000, 10000];

const across = (frequency) => Math.log(frequency / LOW) / Math.log(HIGH / LOW);
const named = (frequency) => (frequency >= 1000 ? `${frequency / 1000} kHz` : `${frequency} Hz`);

export class SpectrumView {
  #blow = null;
  #trace = [];
  #quietSince = null;
  /** The two spectra that are shown over each other; null while what sounds is shown. */
  compared = null;
  #running = false;

  constructor(spectrumCanvas, decayCanvas) {
    this.spectrum = new Chart(spectrumCanvas);
    this.decay = new Chart(decayCanvas);
    this.modes = null;
    this.engine = null;
    this.analyser = null;
    new ResizeObserver(() => this.#running || this.#draw()).observe(spectrumCanvas);
  }

  /** What is heard from now on: the field's modes, and the engine, or null without sound. The last blow stays drawn. */
  listen(modes, engine) {
    const before = modes.sameContacts(this.modes) ? this.#blow : null;
    this.modes = modes;
    this.engine = engine;
    this.analyser = engine?.analyser ?? null;
    if (engine) {
      engine.onlimited = tellLimited;
      engine.onheld = (held) => (held ? say(HELD, { name: "held", bad: true }) : unsay("held"));
    }
    this.compared = null;
    this.#blow = before && this.#blowOf(before);
    this.#draw();
  }

  /** A blow at a contact sounds from now on: the model's, or the recording of one; the mallet as the engine has it. */
  struck(row, force, { contactTime = 0, shape = "half-sine" } = {}) {
    this.#blow = this.#blowOf({ row, force, contactTime, shape, at: performance.now() });
    this.compared = null;
    this.#run();
  }

  /** A blow of the field that is listened to, with what is drawn of it: from when the mallet lets go, `free`; in ms. */
  #blowOf({ row, force, contactTime, shape, at }) {
    const { modes } = this;
    const rate = modes.sampleRate;
    const pulse = pulseSamples(contactTime, rate, shape);
    const stems = Array.from({ length: modes.count }, (_, mode) => {
      const [frequency, damping] = [modes.frequency(mode), modes.damping(mode, row)];
      const left = swingAfter(pulse, (2 * Math.PI * frequency) / rate, damping / rate);
      return { frequency, level: decibels(force * modes.amplitude(mode, row) * left), damping };
    });
    const loudest = Math.max(...stems.map(({ level }) => level));
    return { row, force, contactTime, shape, at, free: at + 1000 * contactTime, stems, top: Math.ceil((loudest + 6) / 10) * 10, seconds: spanOf(stems) };
  }

  /** Draw two spectra over each other, each {label, levels} with levels in dB from LOW to HIGH. */
  compare(recording, model) {
    this.compared = { recording, model };
    this.#draw();
  }

  static get range() {
    return { low: LOW, high: HIGH, count: 400 };
  }

  /** Decibels by which the engine makes everything louder or softer than the field has it. */
  get #volume() {
    return decibels(this.engine?.level ?? 1);
  }

  #run() {
    this.#trace = [];
    this.#quietSince = null;
    if (this.#running) return;
    this.#running = true;
    const step = () => {
      this.#running = this.#listenOnce();
      this.#draw();
      if (this.#running) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  /** Take down the level of this moment; returns whether anything is to come. */
  #listenOnce() {
    const seconds = this.#blow ? (performance.now() - this.#blow.free) / 1000 : 0;
    if (!this.analyser) return this.#blow !== null && seconds < this.#blow.seconds;
    this.wave ??= new Float32Array(this.analyser.fftSize);
    this.lines ??= new Float32Array(this.analyser.frequencyBinCount);
    this.analyser.getFloatTimeDomainData(this.wave);
    this.analyser.getFloatFrequencyData(this.lines);
    // The newest part only, so that the decay isn't blurred by the long window of the spectrum.
    const newest = this.wave.subarray(Math.max(0, this.wave.length - 1024));
    const power = newest.reduce((sum, value) => sum + value * value, 0) / newest.length;
    const level = decibels(Math.sqrt(power)) - this.#volume;
    this.#trace.push([seconds, level]);
    const top = this.#blow?.top ?? 0;
    if (level > top - RANGE_DB - 10) this.#quietSince = null;
    else this.#quietSince ??= seconds;
    const span = this.#blow?.seconds ?? 0;
    return this.#quietSince === null || seconds - this.#quietSince < QUIET_SECONDS || seconds < Math.min(span, 1);
  }

  #draw() {
    this.#drawSpectrum();
    this.#drawDecay();
  }

  #drawSpectrum() {
    const { spectrum: chart } = this;
    chart.begin();
    const top = this.compared ? 0 : (this.#blow?.top ?? 0);
    const down = (level) => (top - level) / RANGE_DB;
    chart.axes(
      LABELLED.map((frequency) => ({ share: across(frequency), words: named(frequency) })),
      [0, 0.25, 0.5, 0.75, 1].map((share) => ({ share, words: `${Math.round(top - share * RANGE_DB)}` })),
    );
    if (this.compared) {
      for (const [{ levels }, color, dash] of [
        [this.compared.recording, chart.ink.second, []],
        [this.compared.model, chart.ink.first, []],
      ]) {
        const loudest = Math.max(...levels);
        const shares = Array.from(levels, (level, place) => [place / (levels.length - 1), down(level - loudest)]);
        chart.curve(shares, color, { width: 1.3, dash });
      }
      return;
    }
    if (this.#blow) {
      const seconds = (performance.now() - this.#blow.free) / 1000;
      for (const { frequency, level, damping } of this.#blow.stems) {
        const now = level - decibels(Math.exp(1)) * damping * seconds;
        if (frequency < LOW || frequency > HIGH) continue;
        const place = across(frequency);
        // What it was at the blow stays to be seen, faintly.
        for (const [height, color, width] of [
          [level, chart.ink.faint, 1],
          [now, chart.ink.first, 2],
        ]) {
          if (height < top - RANGE_DB) continue;
          chart.curve([[place, 1], [place, down(height)]], color, { width });
        }
      }
    }
    if (this.analyser && this.lines && this.#running) {
      const hertz = this.analyser.context.sampleRate / this.analyser.fftSize;
      const shares = [];
      for (let line = Math.ceil(LOW / hertz); line < this.lines.length && line * hertz <= HIGH; line++)
        shares.push([across(line * hertz), down(Math.max(this.lines[line] + ANALYSER_DB - this.#volume, -1000))]);
      if (shares.length) chart.curve(shares, chart.ink.second, { width: 1.2, fill: true });
    }
  }

  #drawDecay() {
    const { decay: chart } = this;
    chart.begin();
    const seconds = this.#blow?.seconds ?? 1;
    const top = this.#blow?.top ?? 0;
    const down = (level) => (top - level) / RANGE_DB;
    const named = (share) => `${Number((share * seconds).toPrecision(2))} s`;
    chart.axes(
      (chart.width < 240 ? [0.5, 1] : [0.25, 0.5, 0.75, 1]).map((share) => ({ share, words: named(share) })),
      [0, 0.25, 0.5, 0.75, 1].map((share) => ({ share, words: `${Math.round(top - share * RANGE_DB)}` })),
    );
    if (this.#trace.length > 1) {
      for (const piece of unbroken(this.#trace)) {
        const shares = piece.map(([at, level]) => [at / seconds, down(level)]);
        chart.curve(shares, chart.ink.second, { fill: true });
      }
    }
    if (this.#blow) {
      const shares = Array.from({ length: 101 }, (_, step) => {
        const at = (step / 100) * seconds;
        const power = this.#blow.stems.reduce(
          (sum, { level, damping }) => sum + 0.5 * 10 ** (level / 10) * Math.exp(-2 * damping * at),
          0,
        );
        return [step / 100, down(10 * Math.log10(power + 1e-30))];
      });
      chart.curve(shares, chart.ink.first, { dash: [5, 4] });
    }
  }
}

/** The pieces of a row of [seconds, level] between which nobody looked for too long. */
function unbroken(trace) {
  const pieces = [[]];
  trace.forEach((point, place) => {
    if (place && point[0] - trace[place - 1][0] > GAP_SECONDS) pieces.push([]);
    pieces.at(-1).push(point);
  });
  return pieces;
}

let forgetting;

function tellLimited(limited) {
  const word = document.getElementById("limited");
  clearTimeout(forgetting);
  if (limited) word.hidden = false;
  else forgetting = setTimeout(() => (word.hidden = true), 1000 * LIMITED_SECONDS);
}

/** Seconds that show the modes' sound fall by the range of the chart, or most of it. */
function spanOf(stems) {
  const loudest = Math.max(...stems.map(({ level }) => level));
  const longest = stems.map(({ level, damping }) =>
    Math.max(0, (level - loudest + RANGE_DB) / (decibels(Math.exp(1)) * damping)),
  );
  return Math.min(Math.max(...longest, 0.1), 6);
}

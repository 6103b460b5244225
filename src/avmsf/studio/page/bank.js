// The modal bank: impacts in, sound out, on the audio thread.
//
// A mode's sound after an impact is Re(a z^n) with z = exp((-d + 2 pi i f) / rate) and a = cosine - i sine, so that one
// whose force is x[n] drives the resonator s[n] = z s[n-1] + a x[n], heard as Re(s[n]). Where all contacts share their
// dampings the bank is linear: one resonator a mode serves all impacts exactly, however many they are. Where dampings
// depend on the contact every impact brings resonators of its own.
//
// Between inputs a mode is run as y[n] = 2 Re(z) y[n-1] - |z|^2 y[n-2] within a block and its complex state is carried
// from block to block by z^block, so that rounding does not add up over seconds. All in double precision.
//
// All of it is one module that imports nothing, long as it is: an audio thread loads a page's worklet as one file, and
// from a page that is itself one file there is nothing else to be had.

/** Amplitude, over that of an impact's loudest mode, below which all that is left out of an impact lies: -120 dB. */
const INAUDIBLE = 1e-6;
/** Loudest sample that leaves. */
const CEILING = 0.98;
/** Louder than any sound, in either direction: what is, and what is no number, is a fault and left out. */
const ABSURD = 1e9;
/** Seconds in which the limiter lets go. */
const RELEASE = 0.1;
/** Seconds in which an impact that has to make room, or a field that was replaced, fades. */
const FADE = 0.01;
/** Seconds in which the noise fades behind the end of its draw. */
const NOISE_FADE = 0.05;
/** Seconds between two words to the page on whether the limiter is at work. */
const REPORT = 0.05;

/** Modes with their states, at first silent. */
export class Resonators {
  constructor(frequency, damping, rate, block) {
    const modes = frequency.length;
    this.modes = modes;
    // One place more than there are modes: a silent one, with which groups of four are filled up.
    for (const name of ["zRe", "zIm", "stepRe", "stepIm", "twice", "square", "re", "im"])
      this[name] = new Float64Array(modes + 1);
    this.ringing = new Int32Array(modes + 4);
    this.count = 0;
    this.rings = new Uint8Array(modes + 1);
    for (let mode = 0; mode < modes; mode++) {
      const angle = (2 * Math.PI * frequency[mode]) / rate;
      const radius = Math.exp(-damping[mode] / rate);
      this.zRe[mode] = radius * Math.cos(angle);
      this.zIm[mode] = radius * Math.sin(angle);
      this.twice[mode] = 2 * this.zRe[mode];
      this.square[mode] = radius * radius;
      const far = Math.exp((-damping[mode] * block) / rate);
      this.stepRe[mode] = far * Math.cos(angle * block);
      this.stepIm[mode] = far * Math.sin(angle * block);
    }
  }

  /** Add a block of what is ringing to `out`, and forget modes whose amplitude has fallen below `floor`. */
  run(out, block, floor) {
    const { re, im, zRe, zIm, twice, square, ringing, modes } = this;
    for (let filled = this.count; filled % 4 !== 0; filled++) ringing[filled] = modes;
    for (let group = 0; group < this.count; group += 4) {
      // Four at once, so that none waits for its own last result.
      const a = ringing[group], b = ringing[group + 1], c = ringing[group + 2], d = ringing[group + 3];
      const twiceA = twice[a], twiceB = twice[b], twiceC = twice[c], twiceD = twice[d];
      const squareA = square[a], squareB = square[b], squareC = square[c], squareD = square[d];
      let lastA = re[a], lastB = re[b], lastC = re[c], lastD = re[d];
      let nowA = zRe[a] * re[a] - zIm[a] * im[a], nowB = zRe[b] * re[b] - zIm[b] * im[b];
      let nowC = zRe[c] * re[c] - zIm[c] * im[c], nowD = zRe[d] * re[d] - zIm[d] * im[d];
      for (let n = 0; n < block; n++) {
        out[n] += nowA + nowB + (nowC + nowD);
        const nextA = twiceA * nowA - squareA * lastA, nextB = twiceB * nowB - squareB * lastB;
        const nextC = twiceC * nowC - squareC * lastC, nextD = twiceD * nowD - squareD * lastD;
        lastA = nowA; lastB = nowB; lastC = nowC; lastD = nowD;
        nowA = nextA; nowB = nextB; nowC = nextC; nowD = nextD;
      }
    }
    this.advance(floor);
  }

  advance(floor) {
    const { re, im, stepRe, stepIm, ringing, rings } = this;
    const least = floor * floor;
    let kept = 0;
    for (let place = 0; place < this.count; place++) {
      const mode = ringing[place];
      const moved = stepRe[mode] * re[mode] - stepIm[mode] * im[mode];
      im[mode] = stepRe[mode] * im[mode] + stepIm[mode] * re[mode];
      re[mode] = moved;
      if (re[mode] * re[mode] + im[mode] * im[mode] > least) {
        ringing[kept++] = mode;
      } else {
        re[mode] = im[mode] = 0;
        rings[mode] = 0;
      }
    }
    this.count = kept;
  }

  /**
   * Drive the modes by `force[from..]`, the first of it at sample `begin` of the block, after `run`. Adds what is heard
   * of that in this block to `out` and leaves the states at the block's end. Modes of an amplitude up to `least` are
   * left out.
   */
  drive(sine, cosine, force, from, begin, out, block, least) {
    const { re, im, zRe, zIm, ringing, rings } = this;
    const end = Math.min(block, begin + force.length - from);
    for (let mode = 0; mode < this.modes; mode++) {
      const inRe = cosine[mode], inIm = -sine[mode];
      if (inRe * inRe + inIm * inIm <= least * least) continue;
      const turnRe = zRe[mode], turnIm = zIm[mode];
      let nowRe = 0, nowIm = 0;
      for (let n = begin; n < end; n++) {
        const input = force[from + n - begin];
        const moved = turnRe * nowRe - turnIm * nowIm + inRe * input;
        nowIm = turnRe * nowIm + turnIm * nowRe + inIm * input;
        nowRe = moved;
        out[n] += nowRe;
      }
      for (let n = end; n < block; n++) {
        const moved = turnRe * nowRe - turnIm * nowIm;
        nowIm = turnRe * nowIm + turnIm * nowRe;
        nowRe = moved;
        out[n] += nowRe;
      }
      re[mode] += nowRe;
      im[mode] += nowIm;
      if (!rings[mode]) {
        rings[mode] = 1;
        ringing[this.count++] = mode;
      }
    }
  }

  get energy() {
    const { re, im } = this;
    return this.ringing.subarray(0, this.count).reduce((sum, mode) => sum + re[mode] ** 2 + im[mode] ** 2, 0);
  }
}

/**
 * All impacts on one field.
 *
 * `field`: frequency and damping (null where every impact brings its own), Hz and 1/s; noise, a draw at this rate.
 * An impact: `frame` at which it starts, `sine` and `cosine` a mode, `damping` a mode or null, `force` a sample, its
 * sum `strength`, `noise`, a factor on the draw, and `loudest`, the amplitude of its loudest mode after the force.
 */
export class Bank {
  constructor(field, rate, block, voices) {
    this.field = field;
    this.rate = rate;
    this.block = block;
    this.voices = voices;
    this.modes = field.frequency.length;
    this.noisy = field.noise.some((value) => value !== 0);
    this.shared = field.damping === null ? null : new Resonators(field.frequency, field.damping, rate, block);
    this.waiting = [];
    this.sounding = [];
    this.scratch = new Float64Array(block);
    this.begun = [];
    /** Of what rings in shared resonators: the lowest floor of the impacts that have a part in it. */
    this.floor = Infinity;
  }

  strike(impact) {
    this.waiting.push(impact);
  }

  /** Add the block that begins at `frame` to `out`. */
  render(out, frame) {
    if (this.waiting.length) this.begin(frame);
    const { shared, block } = this;
    if (shared !== null) shared.run(out, block, this.floor);
    for (const voice of this.sounding) {
      const target = voice.leaving === Infinity ? out : this.scratch.fill(0);
      const begin = Math.max(0, voice.frame - frame);
      const own = voice.resonators;
      if (own !== null) own.run(target, block, voice.floor);
      if (voice.fed < voice.force.length) {
        // Of shared resonators an impact cannot be taken back: it only stops its noise, once it is fed.
        const heard = own === null ? out : target;
        (own ?? shared).drive(voice.sine, voice.cosine, voice.force, voice.fed, begin, heard, block, voice.least);
        voice.fed += block - begin;
      }
      if (this.noisy && voice.leaving > 0) this.addNoise(voice, target, begin);
      if (voice.leaving !== Infinity) this.fade(voice, out);
    }
    this.end();
  }

  begin(frame) {
    const later = [];
    for (const impact of this.waiting) {
      if (impact.frame >= frame + this.block) {
        later.push(impact);
        continue;
      }
      if (this.sounding.filter((voice) => voice.leaving === Infinity).length >= this.voices) this.makeRoom();
      const voice = { ...impact, frame: Math.max(impact.frame, frame), fed: 0, heard: 0, leaving: Infinity };
      voice.floor = (INAUDIBLE * impact.loudest) / this.modes;
      voice.least = impact.strength === 0 ? Infinity : voice.floor / Math.abs(impact.strength);
      voice.resonators = null;
      if (this.shared !== null) this.floor = Math.min(this.floor, voice.floor);
      else voice.resonators = new Resonators(this.field.frequency, impact.damping, this.rate, this.block);
      this.sounding.push(voice);
      this.begun.push(voice.frame);
    }
    this.waiting = later;
  }

  makeRoom() {
    let quietest = null, least = Infinity;
    for (const voice of this.sounding) {
      if (voice.leaving !== Infinity) continue;
      // One that is still being fed would be cut at its loudest.
      const energy = voice.fed < voice.force.length ? Number.MAX_VALUE : (voice.resonators?.energy ?? voice.frame);
      if (energy < least) [quietest, least] = [voice, energy];
    }
    if (quietest !== null) quietest.leaving = Math.round(FADE * this.rate);
  }

  addNoise(voice, out, begin) {
    const noise = this.field.noise, length = noise.length, fade = NOISE_FADE * this.rate;
    const end = Math.min(this.block, begin + Math.ceil(length + Math.min(fade, length)) - voice.heard);
    for (let n = begin; n < end; n++) {
      const place = voice.heard + n - begin;
      // Behind its end the draw runs backwards and fades, for noise that breaks off is heard as a click.
      const over = place - length;
      const gain = over < 0 ? 1 : 0.5 + 0.5 * Math.cos((Math.PI * Math.min(over, fade)) / fade);
      out[n] += voice.noise * gain * noise[over < 0 ? place : length - 1 - over];
    }
    voice.heard += this.block - begin;
  }

  fade(voice, out) {
    const whole = Math.round(FADE * this.rate);
    for (let n = 0; n < this.block; n++) {
      const left = Math.max(0, voice.leaving - n) / whole;
      out[n] += this.scratch[n] * (0.5 - 0.5 * Math.cos(Math.PI * left));
    }
    voice.leaving = Math.max(0, voice.leaving - this.block);
  }

  end() {
    let kept = 0;
    const fade = NOISE_FADE * this.rate, length = this.field.noise.length;
    for (const voice of this.sounding) {
      const noise = this.noisy && voice.heard < length + Math.min(fade, length);
      const own = voice.resonators, feeding = voice.fed < voice.force.length;
      // What an impact has given to shared resonators rings on without it; it is only waited for until it is fed.
      const stays = voice.leaving > 0 ? noise || feeding || own?.count > 0 : own === null && feeding;
      if (stays) this.sounding[kept++] = voice;
    }
    this.sounding.length = kept;
    if (this.shared?.count === 0 && kept === 0) this.floor = Infinity;
  }
}

/**
 * Holds samples under the ceiling: turned down before the peak comes and let up slowly. Below the ceiling, less what is
 * let up during the delay, they leave as they are, to the bit. All are late by `ahead` samples.
 */
export class Limiter {
  constructor(rate, ahead) {
    this.release = Math.exp(-1 / (RELEASE * rate));
    // A peak is remembered this much smaller when the samples that it belongs to leave.
    this.most = CEILING * this.release ** ahead;
    this.span = ahead + 1;
    this.late = new Float64Array(this.span);
    // By how much each of the last samples asked for less, and their sum: the mean of them slopes down to a peak.
    this.less = new Float64Array(this.span);
    this.sum = 0;
    this.untouched = 0;
    this.place = 0;
    this.peak = 0;
    this.limited = false;
  }

  hold(samples, block) {
    const { late, less, span, release, most } = this;
    for (let n = 0; n < block; n++) {
      const { place } = this;
      late[place] = Math.abs(samples[n]) < ABSURD ? samples[n] : 0;
      this.peak = Math.max(Math.abs(late[place]), this.peak * release);
      const wanted = this.peak > most ? 1 - most / this.peak : 0;
      this.sum += wanted - less[place];
      less[place] = wanted;
      if (wanted > 0) {
        this.limited = true;
        this.untouched = 0;
      } else if (++this.untouched >= span) {
        // Not what rounding has left of the sum.
        this.sum = 0;
      }
      this.place = place + 1 === span ? 0 : place + 1;
      samples[n] = late[this.place] * (1 - this.sum / span);
    }
    // Long silence must not creep towards the smallest of numbers, which are slow.
    if (this.peak < 1e-30) this.peak = 0;
  }
}

// The page's own thread may import the classes, and has no processors.
if (typeof AudioWorkletProcessor !== "undefined") {
  const BLOCK = 128;

  class ModalBankProcessor extends AudioWorkletProcessor {
    constructor({ processorOptions: { field, level, voices, impacts, ahead } }) {
      super();
      this.bank = new Bank(field, sampleRate, BLOCK, voices);
      for (const impact of impacts) this.bank.strike(impact);
      this.leaving = [];
      this.limiter = new Limiter(sampleRate, ahead);
      this.ahead = ahead;
      this.level = this.wanted = level;
      this.mix = new Float64Array(BLOCK);
      this.old = new Float64Array(BLOCK);
      this.reported = 0;
      this.said = false;
      this.port.onmessage = ({ data: { type, impact, level, field } }) => {
        if (type === "strike") this.bank.strike(impact);
        if (type === "level") this.wanted = level;
        if (type === "field") {
          this.leaving.push({ bank: this.bank, left: Math.round(FADE * sampleRate) });
          this.bank = new Bank(field, sampleRate, BLOCK, voices);
        }
      };
    }

    process(inputs, outputs) {
      const mix = this.mix.fill(0);
      this.bank.render(mix, currentFrame);
      for (const leaver of this.leaving) this.takeLeave(leaver, mix);
      this.leaving = this.leaving.filter((leaver) => leaver.left > 0);
      const recording = inputs[0]?.[0];
      const change = (this.wanted - this.level) / BLOCK;
      for (let n = 0; n < BLOCK; n++) {
        if (recording) mix[n] += recording[n];
        mix[n] *= this.level + change * (n + 1);
      }
      this.level = this.wanted;
      this.limiter.hold(mix, BLOCK);
      for (const channel of outputs[0]) channel.set(mix);
      this.report();
      return true;
    }

    takeLeave(leaver, mix) {
      const old = this.old.fill(0), whole = Math.round(FADE * sampleRate);
      leaver.bank.render(old, currentFrame);
      for (let n = 0; n < BLOCK; n++)
        mix[n] += old[n] * (0.5 - 0.5 * Math.cos((Math.PI * Math.max(0, leaver.left - n)) / whole));
      leaver.left -= BLOCK;
    }

    report() {
      const { begun } = this.bank;
      for (const frame of begun) this.port.postMessage({ type: "begun", frame: frame + this.ahead });
      begun.length = 0;
      if (currentFrame - this.reported < REPORT * sampleRate) return;
      const { limited } = this.limiter;
      if (limited !== this.said) this.port.postMessage({ type: "limited", limited });
      this.reported = currentFrame;
      this.said = limited;
      this.limiter.limited = false;
    }
  }

  registerProcessor("avmsf-modal-bank", ModalBankProcessor);
}

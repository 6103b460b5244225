/** What the modes' table, the pictures and the paint ask of a field: levels, times and shapes. */

const DECIBELS = 20 / Math.LN10;
const SIXTY_DB = Math.log(1000);

export const decibels = (amplitude) => DECIBELS * Math.log(Math.max(amplitude, 1e-12));

export class Modes {
  constructor({ manifest, tensors, contacts }) {
    this.count = manifest.modes ?? 0;
    /** Rows that are no modes of the object, but describe what its modes do not explain. */
    this.supporting = new Set(manifest.supporting ?? []);
    this.sampleRate = manifest.sampleRate;
    this.shared = manifest.damping !== "perContact";
    this.tensors = tensors;
    this.contacts = contacts;
  }

  frequency(mode) {
    return this.tensors.frequency[mode];
  }

  /** 1/s, at a contact. */
  damping(mode, row) {
    return this.tensors.damping[this.shared ? mode : row * this.count + mode];
  }

  /** Seconds in which the mode falls by 60 dB. */
  decayTime(mode, row) {
    return SIXTY_DB / this.damping(mode, row);
  }

  /** How strong an impact of force 1 at a contact sets the mode swinging. */
  amplitude(mode, row) {
    const at = row * this.count + mode;
    return Math.hypot(this.tensors.sine[at], this.tensors.cosine[at]);
  }

  /** Levels of all modes at a contact, dB below the loudest; NaN where there is no contact. */
  levels(row) {
    const amplitudes = Array.from({ length: this.count }, (_, mode) => this.amplitude(mode, row));
    const loudest = Math.max(...amplitudes);
    return amplitudes.map((value) => decibels(value / loudest));
  }

  /** A mode's gain at every contact over its greatest, from -1 to 1, along the phase that most of its power has. */
  shape(mode) {
    const { sine, cosine } = this.tensors;
    let [difference, product] = [0, 0];
    for (let row = 0; row < this.contacts.count; row++) {
      const at = row * this.count + mode;
      difference += sine[at] ** 2 - cosine[at] ** 2;
      product += 2 * sine[at] * cosine[at];
    }
    const phase = Math.atan2(product, difference) / 2;
    const gains = new Float32Array(this.contacts.count);
    let greatest = 0;
    for (let row = 0; row < this.contacts.count; row++) {
      const at = row * this.count + mode;
      gains[row] = sine[at] * Math.cos(phase) + cosine[at] * Math.sin(phase);
      greatest = Math.max(greatest, Math.abs(gains[row]));
    }
    return greatest ? gains.map((value) => value / greatest) : gains;
  }

  /** The contact at which an impact is loudest. */
  get loudestRow() {
    const powers = new Float64Array(this.contacts.count);
    for (let row = 0; row < powers.length; row++)
      for (let mode = 0; mode < this.count; mode++) powers[row] += this.amplitude(mode, row) ** 2;
    return Math.max(0, powers.indexOf(powers.reduce((most, power) => Math.max(most, power), 0)));
  }
}

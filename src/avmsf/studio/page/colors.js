/** Colormaps, those of the package's figures (`plotting/style.py`): viridis for amounts, RdBu_r for signed values. */

const AMOUNT = [
  [68, 1, 84],
  [71, 45, 123],
  [59, 82, 139],
  [44, 114, 142],
  [33, 145, 140],
  [40, 174, 128],
  [94, 201, 98],
  [173, 220, 48],
  [253, 231, 37],
];
const SIGN = [
  [5, 48, 97],
  [32, 101, 171],
  [67, 147, 195],
  [144, 196, 221],
  [209, 229, 240],
  [247, 246, 246],
  [253, 219, 199],
  [243, 164, 129],
  [214, 96, 77],
  [177, 24, 43],
  [103, 0, 31],
];

/** A scale takes one value to [red, green, blue] of 0..255 and tells the style sheet what it looks like. */
class Scale {
  constructor(stops, toShare) {
    this.stops = stops;
    this.toShare = toShare;
  }

  color(value) {
    const { stops } = this;
    const at = Math.min(Math.max(this.toShare(value), 0), 1) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    return stops[low].map((channel, index) => channel + (at - low) * (stops[low + 1][index] - channel));
  }

  /** Red, green, blue of every value, 0..255, three bytes each. */
  colors(values) {
    const all = new Uint8Array(3 * values.length);
    for (let row = 0; row < values.length; row++) all.set(this.color(values[row]).map(Math.round), 3 * row);
    return all;
  }

  get gradient() {
    return `linear-gradient(to right, ${this.stops.map((stop) => `rgb(${stop.join(" ")})`).join(", ")})`;
  }
}

/** From 0, nothing, to 1, the most there is. */
export const amountScale = new Scale(AMOUNT, (value) => value);

/** From -1 over 0 to 1. */
export const signScale = new Scale(SIGN, (value) => (value + 1) / 2);

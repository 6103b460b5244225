/** Colors for numbers: one ramp for amounts, one for signs; the legend draws the very same. */

const AMOUNT = [
  [28, 16, 68],
  [96, 28, 122],
  [172, 48, 108],
  [230, 92, 72],
  [250, 164, 64],
  [252, 240, 170],
];
const SIGN = [
  [24, 78, 170],
  [98, 152, 216],
  [226, 226, 222],
  [226, 134, 96],
  [176, 32, 44],
];

function between(stops, share) {
  const place = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(place), stops.length - 2);
  return stops[low].map((value, channel) => value + (place - low) * (stops[low + 1][channel] - value));
}

/** A scale takes one value to [red, green, blue] of 0..255 and tells the style sheet what it looks like. */
class Scale {
  constructor(stops, toShare) {
    this.stops = stops;
    this.toShare = toShare;
  }

  color(value) {
    return between(this.stops, this.toShare(value));
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

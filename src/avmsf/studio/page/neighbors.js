/** What lies between contacts is painted as the nearest of them are. */

const NEIGHBORS = 3;

/** Rows and weights of the contacts nearest to each of many places. */
export class Neighbors {
  constructor(grid, places) {
    // Corners of neighboring triangles are one place.
    const { which, firsts } = together(places);
    this.which = which;
    this.rows = new Uint32Array(NEIGHBORS * firsts.length);
    this.weights = new Float32Array(NEIGHBORS * firsts.length);
    const rows = new Int32Array(NEIGHBORS), distances = new Float64Array(NEIGHBORS);
    firsts.forEach((first, place) => {
      const [x, y, z] = [places[3 * first], places[3 * first + 1], places[3 * first + 2]];
      const found = grid.nearestInto(x, y, z, NEIGHBORS, rows, distances);
      let sum = 0;
      for (let rank = 0; rank < found; rank++) sum += 1 / (distances[rank] + 1e-3 * grid.cell) ** 2;
      for (let rank = 0; rank < found; rank++) {
        this.rows[NEIGHBORS * place + rank] = rows[rank];
        this.weights[NEIGHBORS * place + rank] = 1 / (distances[rank] + 1e-3 * grid.cell) ** 2 / sum;
      }
    });
  }

  /** Bytes of `colors`, three for each contact, mixed for every place, and each taken through `change`. */
  mix(colors, change = (value) => value) {
    const mixed = new Float32Array(this.rows.length);
    for (let entry = 0; entry < this.rows.length; entry++) {
      const place = 3 * Math.floor(entry / NEIGHBORS), row = 3 * this.rows[entry], weight = this.weights[entry];
      for (let channel = 0; channel < 3; channel++) mixed[place + channel] += weight * colors[row + channel];
    }
    for (let place = 0; place < mixed.length; place++) mixed[place] = change(mixed[place]);
    const all = new Float32Array(3 * this.which.length);
    for (let place = 0; place < this.which.length; place++)
      for (let channel = 0; channel < 3; channel++) all[3 * place + channel] = mixed[3 * this.which[place] + channel];
    return all;
  }
}

/** Number the places that differ: `which` is each place's number, `firsts` where each of the numbered is first. */
function together(places) {
  const count = places.length / 3;
  const bits = new Int32Array(places.buffer, places.byteOffset, places.length);
  const mask = 2 ** Math.ceil(Math.log2(2 * count + 2)) - 1;
  const table = new Int32Array(mask + 1).fill(-1);
  const which = new Uint32Array(count), firsts = new Uint32Array(count);
  let known = 0;
  for (let place = 0; place < count; place++) {
    const x = bits[3 * place], y = bits[3 * place + 1], z = bits[3 * place + 2];
    let at = (Math.imul(x, 0x9e3779b1) ^ Math.imul(y, 0x85ebca6b) ^ Math.imul(z, 0xc2b2ae35)) >>> 0;
    for (at = (at ^ (at >>> 15)) & mask; table[at] >= 0; at = (at + 1) & mask) {
      const first = 3 * firsts[table[at]];
      if (bits[first] === x && bits[first + 1] === y && bits[first + 2] === z) break;
    }
    if (table[at] < 0) {
      firsts[known] = place;
      table[at] = known++;
    }
    which[place] = table[at];
  }
  return { which, firsts: firsts.subarray(0, known) };
}

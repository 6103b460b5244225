/** Which of many points lies nearest to a place: the points sorted into cubes. */

/** Cubes that are looked up by their numbers, without an object for each: a table twice as long as there are points. */
const EMPTY = -1;

export class PointGrid {
  #keys;
  #firsts;
  #nexts;
  #mask;
  #rows = new Int32Array(1);
  #distances = new Float64Array(1);

  /** `points`: x, y, z of each, one after another. */
  constructor(points) {
    this.points = points;
    this.count = points.length / 3;
    this.low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let place = 0; place < points.length; place++) {
      this.low[place % 3] = Math.min(this.low[place % 3], points[place]);
      high[place % 3] = Math.max(high[place % 3], points[place]);
    }
    const sides = this.low.map((value, axis) => high[axis] - value);
    this.diagonal = Math.hypot(...sides) || 1;
    // Points lie on a surface: about two in each cube that the surface passes through.
    this.cell = Math.max(this.diagonal * Math.sqrt(1 / Math.max(this.count, 1)), this.diagonal / 500);
    this.sizes = sides.map((side) => Math.floor(side / this.cell) + 1);
    this.#fill();
  }

  #fill() {
    const { points, count, low, cell, sizes } = this;
    const places = 2 ** Math.ceil(Math.log2(2 * count + 2));
    this.#mask = places - 1;
    this.#keys = new Int32Array(places).fill(EMPTY);
    this.#firsts = new Int32Array(places).fill(EMPTY);
    this.#nexts = new Int32Array(count);
    // From the last on, so that each cube lists its rows in their order.
    for (let row = count - 1; row >= 0; row--) {
      const [i, j, k] = [0, 1, 2].map((axis) => Math.floor((points[3 * row + axis] - low[axis]) / cell));
      const key = i + sizes[0] * (j + sizes[1] * k);
      const place = this.#placeOf(key);
      this.#keys[place] = key;
      this.#nexts[row] = this.#firsts[place];
      this.#firsts[place] = row;
    }
  }

  /** Where a cube is in the table, or would be. */
  #placeOf(key) {
    let place = Math.imul(key, 0x9e3779b1) >>> 7 & this.#mask;
    while (this.#keys[place] !== key && this.#keys[place] !== EMPTY) place = (place + 1) & this.#mask;
    return place;
  }

  /** The `count` nearest rows, nearest first, each as {row, distance}. */
  nearest(x, y, z, count = 1) {
    if (this.#rows.length < count) [this.#rows, this.#distances] = [new Int32Array(count), new Float64Array(count)];
    const found = this.nearestInto(x, y, z, count, this.#rows, this.#distances);
    return Array.from({ length: found }, (_, rank) => ({ row: this.#rows[rank], distance: this.#distances[rank] }));
  }

  /** Write the `count` nearest rows and their distances, nearest first; returns how many there are. */
  nearestInto(x, y, z, count, rows, distances) {
    const { points, low, cell, sizes } = this;
    const [width, height, depth] = sizes;
    const clamp = (value, axis) => Math.min(Math.max(Math.floor((value - low[axis]) / cell), 0), sizes[axis] - 1);
    const i = clamp(x, 0), j = clamp(y, 1), k = clamp(z, 2);
    const widest = Math.max(width, height, depth);
    // Whatever lies beyond a shell is at least as far as the nearest of its faces that has points behind it.
    const beyond = (value, axis, middle, reach) => Math.min(
      middle - reach <= 0 ? Infinity : value - (low[axis] + (middle - reach) * cell),
      middle + reach >= sizes[axis] - 1 ? Infinity : low[axis] + (middle + reach + 1) * cell - value,
    );
    let found = 0;
    for (let reach = 0; reach < widest; reach++) {
      for (let c = Math.max(k - reach, 0); c <= Math.min(k + reach, depth - 1); c++)
        for (let b = Math.max(j - reach, 0); b <= Math.min(j + reach, height - 1); b++) {
          const inside = Math.abs(c - k) < reach && Math.abs(b - j) < reach;
          for (let a = i - reach; a <= i + reach; a += inside ? 2 * reach : 1) {
            if (a < 0 || a >= width) continue;
            let row = this.#firsts[this.#placeOf(a + width * (b + height * c))];
            for (; row !== EMPTY; row = this.#nexts[row]) {
              const dx = x - points[3 * row], dy = y - points[3 * row + 1], dz = z - points[3 * row + 2];
              const distance = Math.sqrt(dx * dx + dy * dy + dz * dz);
              if (found === count && distance >= distances[count - 1]) continue;
              let rank = found === count ? count - 1 : found++;
              for (; rank > 0 && distances[rank - 1] > distance; rank--) {
                rows[rank] = rows[rank - 1];
                distances[rank] = distances[rank - 1];
              }
              rows[rank] = row;
              distances[rank] = distance;
            }
          }
        }
      if (found < count) continue;
      const face = Math.min(beyond(x, 0, i, reach), beyond(y, 1, j, reach), beyond(z, 2, k, reach));
      if (distances[count - 1] <= face) break;
    }
    return found;
  }

  /** How far apart neighbors lie, in the middle of the list of some of them. */
  get spacing() {
    if (this.count < 2) return this.diagonal / 50;
    const step = Math.max(1, Math.floor(this.count / 200));
    const gaps = [];
    for (let row = 0; row < this.count; row += step) {
      const [, next] = this.nearest(...this.points.subarray(3 * row, 3 * row + 3), 2);
      gaps.push(next.distance);
    }
    return gaps.sort((one, other) => one - other)[gaps.length >> 1] || this.diagonal / 50;
  }
}

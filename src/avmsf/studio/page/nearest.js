/** Which of many points lies nearest to a place: the points sorted into cubes. */

export class PointGrid {
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
    this.cells = new Map();
    for (let row = 0; row < this.count; row++) {
      const key = this.#key(...this.#cellOf(points[3 * row], points[3 * row + 1], points[3 * row + 2]));
      const there = this.cells.get(key);
      if (there) there.push(row);
      else this.cells.set(key, [row]);
    }
  }

  #cellOf(...place) {
    return place.map((value, axis) => Math.floor((value - this.low[axis]) / this.cell));
  }

  #key(i, j, k) {
    return i + this.sizes[0] * (j + this.sizes[1] * k);
  }

  /** The `count` nearest rows, nearest first, each as {row, distance}. */
  nearest(x, y, z, count = 1) {
    const place = [x, y, z];
    const middle = this.#cellOf(x, y, z).map((cell, axis) => Math.min(Math.max(cell, 0), this.sizes[axis] - 1));
    const widest = Math.max(...this.sizes);
    const found = [];
    for (let reach = 0; reach < widest; reach++) {
      this.#visitShell(middle, reach, (row) => {
        const [dx, dy, dz] = [x - this.points[3 * row], y - this.points[3 * row + 1], z - this.points[3 * row + 2]];
        const distance = Math.sqrt(dx * dx + dy * dy + dz * dz);
        if (found.length === count && distance >= found[count - 1].distance) return;
        if (found.length === count) found.pop();
        let rank = found.length;
        while (rank > 0 && found[rank - 1].distance > distance) rank--;
        found.splice(rank, 0, { row, distance });
      });
      // Whatever lies beyond this shell is at least as far as the nearest of its faces that has points behind it.
      const face = Math.min(
        ...place.map((value, axis) => {
          const [first, last] = [middle[axis] - reach, middle[axis] + reach];
          const below = first <= 0 ? Infinity : value - (this.low[axis] + first * this.cell);
          const above = last >= this.sizes[axis] - 1 ? Infinity : this.low[axis] + (last + 1) * this.cell - value;
          return Math.min(below, above);
        }),
      );
      if (found.length === count && found[count - 1].distance <= face) break;
    }
    return found;
  }

  #visitShell([i, j, k], reach, visit) {
    const bounds = [i, j, k].map((cell, axis) => [
      Math.max(cell - reach, 0),
      Math.min(cell + reach, this.sizes[axis] - 1),
    ]);
    for (let c = bounds[2][0]; c <= bounds[2][1]; c++)
      for (let b = bounds[1][0]; b <= bounds[1][1]; b++) {
        const inside = Math.abs(c - k) < reach && Math.abs(b - j) < reach;
        const step = inside ? 2 * reach : 1;
        for (let a = inside ? i - reach : bounds[0][0]; a <= (inside ? i + reach : bounds[0][1]); a += step) {
          if (a < 0 || a >= this.sizes[0]) continue;
          for (const row of this.cells.get(this.#key(a, b, c)) ?? []) visit(row);
        }
      }
  }

  /** How far apart neighbours lie, in the middle of the list of some of them. */
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

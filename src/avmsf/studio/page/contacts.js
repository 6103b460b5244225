/** The contacts of a field, points on the object's surface: which of them is nearest, and how far apart they lie. */

/** On a thin wall contacts of the other side may be nearer than those of the own side, by at most this much. */
const WALL_SPACINGS = 3;

export class Contacts {
  /** `points` and `normals`: x, y, z of each, one after another; normals may be missing. */
  constructor({ points = new Float32Array(0), normals = null }) {
    this.points = points;
    this.normals = normals;
    this.count = points.length / 3;
    this.low = [Infinity, Infinity, Infinity];
    this.high = [-Infinity, -Infinity, -Infinity];
    for (let at = 0; at < points.length; at++) {
      this.low[at % 3] = Math.min(this.low[at % 3], points[at]);
      this.high[at % 3] = Math.max(this.high[at % 3], points[at]);
    }
    this.center = this.low.map((value, axis) => (value + this.high[axis]) / 2);
    this.diagonal = Math.hypot(...this.low.map((value, axis) => this.high[axis] - value)) || 1;
    this.spacing = this.#medianGap();
    this.wall = WALL_SPACINGS * this.spacing;
  }

  /** Whether these are the contacts of another field, in the same rows. */
  equal(other) {
    return this.count === other?.count && this.points.every((value, at) => value === other.points[at]);
  }

  position(row) {
    return Array.from(this.points.subarray(3 * row, 3 * row + 3));
  }

  normal(row) {
    return this.normals && Array.from(this.normals.subarray(3 * row, 3 * row + 3));
  }

  /** Cosine of the angle between a contact's normal and a unit vector; 1 where there are no normals. */
  facing(row, [x, y, z]) {
    const { normals } = this;
    return normals ? normals[3 * row] * x + normals[3 * row + 1] * y + normals[3 * row + 2] * z : 1;
  }

  /** The accepted contact nearest to a position, {row, distance}; at an infinite distance if none is accepted. */
  nearest([x, y, z], accept = () => true) {
    const { points } = this;
    let [nearest, least] = [0, Infinity];
    for (let row = 0; row < this.count; row++) {
      const dx = points[3 * row] - x, dy = points[3 * row + 1] - y, dz = points[3 * row + 2] - z;
      const square = dx * dx + dy * dy + dz * dz;
      if (square < least && accept(row)) [nearest, least] = [row, square];
    }
    return { row: nearest, distance: Math.sqrt(least) };
  }

  /** The nearest contact whose side of a thin wall faces along a direction; where it is far, the nearest of all. */
  nearestFacing(position, direction) {
    const nearest = this.nearest(position);
    const same = this.nearest(position, (row) => this.facing(row, direction) > 0);
    return same.distance <= nearest.distance + this.wall ? same : nearest;
  }

  /** The outward normal at a position; null where both sides of a thin wall are about as near. */
  outward(position) {
    const { row, distance } = this.nearest(position);
    const normal = this.normal(row);
    if (!normal) return null;
    const behind = this.nearest(position, (other) => this.facing(other, normal) < 0);
    return behind.distance < 1.5 * distance + 0.1 * this.spacing ? null : normal;
  }

  /** The median of the distances between neighbors, over some of the contacts. */
  #medianGap() {
    const step = Math.max(1, Math.floor(this.count / 200));
    const gaps = [];
    for (let row = 0; row < this.count && this.count > 1; row += step)
      gaps.push(this.nearest(this.position(row), (other) => other !== row).distance);
    return gaps.sort((one, other) => one - other)[gaps.length >> 1] || this.diagonal / 50;
  }
}

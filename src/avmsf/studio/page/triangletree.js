/** Where a ray meets one of very many triangles: boxes within boxes around them. */

/** Triangles in one of the smallest boxes. */
const FEW = 8;

export class TriangleTree {
  /** `corners`: nine numbers a triangle. */
  constructor(corners) {
    this.corners = corners;
    const count = corners.length / 9;
    this.order = Uint32Array.from({ length: count }, (_, triangle) => triangle);
    this.middles = new Float32Array(3 * count);
    for (let triangle = 0; triangle < count; triangle++)
      for (let axis = 0; axis < 3; axis++) {
        const at = 9 * triangle + axis;
        this.middles[3 * triangle + axis] = (corners[at] + corners[at + 3] + corners[at + 6]) / 3;
      }
    this.root = count ? this.#box(0, count) : null;
  }

  /** A box around the triangles that `order` has from `begin` to `end`: low and high corner, and its two parts. */
  #box(begin, end) {
    const { corners, order } = this;
    const box = new Float32Array([Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity]);
    for (let place = begin; place < end; place++) {
      const from = 9 * order[place];
      for (let at = 0; at < 9; at++) {
        const axis = at % 3, value = corners[from + at];
        if (value < box[axis]) box[axis] = value;
        if (value > box[axis + 3]) box[axis + 3] = value;
      }
    }
    if (end - begin <= FEW) return { box, begin, end, parts: null };
    const split = this.#split(begin, end);
    return { box, begin, end, parts: [this.#box(begin, split), this.#box(split, end)] };
  }

  /** Sort the triangles to either side of the middle, along the axis on which theirs lie furthest apart. */
  #split(begin, end) {
    const { middles, order } = this;
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let place = begin; place < end; place++)
      for (let axis = 0; axis < 3; axis++) {
        const value = middles[3 * order[place] + axis];
        if (value < low[axis]) low[axis] = value;
        if (value > high[axis]) high[axis] = value;
      }
    const sides = high.map((value, axis) => value - low[axis]);
    const axis = sides.indexOf(Math.max(...sides)), middle = (low[axis] + high[axis]) / 2;
    let split = begin;
    for (let place = begin; place < end; place++) {
      if (middles[3 * order[place] + axis] > middle) continue;
      [order[place], order[split]] = [order[split], order[place]];
      split++;
    }
    // All in one place: any halves will do.
    return split === begin || split === end ? (begin + end) >> 1 : split;
  }

  /** How far along a ray, in lengths of its direction, the first triangle on either side is met; Infinity beside all. */
  distance(origin, direction) {
    let nearest = Infinity;
    const waiting = this.root === null ? [] : [this.root];
    while (waiting.length) {
      const node = waiting.pop();
      if (entry(node.box, origin, direction) >= nearest) continue;
      if (node.parts === null) {
        for (let place = node.begin; place < node.end; place++)
          nearest = Math.min(nearest, meeting(this.corners, 9 * this.order[place], origin, direction));
        continue;
      }
      const [one, other] = node.parts;
      // The nearer of the two first: it often hides the other.
      if (entry(one.box, origin, direction) < entry(other.box, origin, direction)) waiting.push(other, one);
      else waiting.push(one, other);
    }
    return nearest;
  }
}

/** How far along a ray it enters a box; Infinity if it never does. */
function entry(box, origin, direction) {
  let first = 0, last = Infinity;
  for (let axis = 0; axis < 3; axis++) {
    const low = box[axis] - origin[axis], high = box[axis + 3] - origin[axis], step = direction[axis];
    if (step === 0) {
      if (low > 0 || high < 0) return Infinity;
      continue;
    }
    first = Math.max(first, Math.min(low / step, high / step));
    last = Math.min(last, Math.max(low / step, high / step));
  }
  return first <= last ? first : Infinity;
}

/** How far along a ray it meets the triangle whose corners begin at `from`; Infinity beside it. */
function meeting(corners, from, [ox, oy, oz], [dx, dy, dz]) {
  const ax = corners[from], ay = corners[from + 1], az = corners[from + 2];
  const bx = corners[from + 3] - ax, by = corners[from + 4] - ay, bz = corners[from + 5] - az;
  const cx = corners[from + 6] - ax, cy = corners[from + 7] - ay, cz = corners[from + 8] - az;
  const px = dy * cz - dz * cy, py = dz * cx - dx * cz, pz = dx * cy - dy * cx;
  const volume = bx * px + by * py + bz * pz;
  if (volume === 0) return Infinity;
  const tx = ox - ax, ty = oy - ay, tz = oz - az;
  const u = (tx * px + ty * py + tz * pz) / volume;
  if (u < 0 || u > 1) return Infinity;
  const qx = ty * bz - tz * by, qy = tz * bx - tx * bz, qz = tx * by - ty * bx;
  const v = (dx * qx + dy * qy + dz * qz) / volume;
  if (v < 0 || u + v > 1) return Infinity;
  const along = (cx * qx + cy * qy + cz * qz) / volume;
  return along >= 0 ? along : Infinity;
}

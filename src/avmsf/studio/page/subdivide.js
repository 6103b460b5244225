/** Finer triangles, so that colors at corners can show what many contacts between the corners have. */

/** Triangles that one becomes, by how many of its edges are halved. */
const PARTS = [1, 2, 3, 4];

/** Halve the edges longer than `longest`, a shared edge on both its sides, while there are at most `most` triangles.
 *
 * `attributes.position.array`: nine numbers a triangle. Other attributes of corners, such as normals, ride along: each
 * a {array, size}; all are cut at the same places.
 */
export function subdivide(attributes, longest, most = 200000) {
  let current = attributes;
  for (let round = 0; round < 12; round++) {
    const long = longEdges(current.position.array, longest);
    const before = long.length;
    const after = long.reduce((sum, edges) => sum + PARTS[count(edges)], 0);
    if (after === before || after > most) return current;
    current = halved(current, long, after);
  }
  return current;
}

/** For each triangle, which edges are long: 1 from its first corner, 2 from its second, 4 from its third. */
function longEdges(array, longest) {
  const long = new Uint8Array(array.length / 9);
  const limit = longest * longest;
  for (let triangle = 0; triangle < long.length; triangle++) {
    const from = 9 * triangle;
    for (let corner = 0; corner < 3; corner++) {
      const one = from + 3 * corner, other = from + 3 * ((corner + 1) % 3);
      const x = array[one] - array[other], y = array[one + 1] - array[other + 1], z = array[one + 2] - array[other + 2];
      if (x * x + y * y + z * z > limit) long[triangle] |= 1 << corner;
    }
  }
  return long;
}

const count = (edges) => (edges & 1) + ((edges >> 1) & 1) + (edges >> 2);

function halved(attributes, long, triangles) {
  // Each new corner is a row or the middle of two, so a cut edge has the very same middle on both its sides.
  const ones = new Uint32Array(3 * triangles), others = new Uint32Array(3 * triangles);
  let next = 0;
  const push = (...corners) => {
    for (let place = 0; place < corners.length; place += 2) {
      ones[next] = corners[place];
      others[next++] = corners[place + 1];
    }
  };
  for (let triangle = 0; triangle < long.length; triangle++) {
    const edges = long[triangle], cuts = count(edges);
    // Turned so that of one or two long edges the first is from `a` to `b`, and of two the second from `b` to `c`.
    const turn = cuts === 1 ? edges >> 1 : cuts === 2 ? { 3: 0, 6: 1, 5: 2 }[edges] : 0;
    const a = 3 * triangle + turn, b = 3 * triangle + ((turn + 1) % 3), c = 3 * triangle + ((turn + 2) % 3);
    if (cuts === 0) push(a, a, b, b, c, c);
    else if (cuts === 1) push(a, a, a, b, c, c, a, b, b, b, c, c);
    else if (cuts === 2) push(a, b, b, b, b, c, a, a, a, b, c, c, a, b, b, c, c, c);
    else push(a, a, a, b, c, a, a, b, b, b, b, c, c, a, b, c, c, c, a, b, b, c, c, a);
  }
  const cut = {};
  for (const [name, { array, size }] of Object.entries(attributes)) {
    const grown = new Float32Array(ones.length * size);
    for (let corner = 0; corner < ones.length; corner++)
      for (let part = 0; part < size; part++)
        grown[corner * size + part] = (array[ones[corner] * size + part] + array[others[corner] * size + part]) / 2;
    cut[name] = { array: grown, size };
  }
  return cut;
}

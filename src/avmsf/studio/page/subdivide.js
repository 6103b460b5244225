/** Finer triangles, so that colours at corners can show what many contacts between the corners have. */

/** Halve the edges longer than `longest`, a shared edge on both its sides, while there are at most `most` triangles.
 *
 * `corners`: nine numbers a triangle. Attributes of corners, such as normals, ride along: each a
 * {array, size}; all are cut at the same places.
 */
export function subdivide(attributes, longest, most = 200000) {
  let current = attributes;
  for (let round = 0; round < 12; round++) {
    const cut = halved(current, longest);
    if (cut === null || cut.position.array.length / 9 > most) return current;
    current = cut;
  }
  return current;
}

function halved(attributes, longest) {
  const { array } = attributes.position;
  const triangles = array.length / 9;
  const names = Object.keys(attributes);
  const grown = Object.fromEntries(names.map((name) => [name, []]));
  let any = false;
  const isLong = (one, other) =>
    Math.hypot(...[0, 1, 2].map((axis) => array[3 * one + axis] - array[3 * other + axis])) > longest;
  // A corner is one row or the middle of two, so a cut edge has the very same middle on both its sides.
  const push = (...corners) => {
    for (const name of names) {
      const { array: values, size } = attributes[name];
      for (const [one, other] of corners)
        for (let place = 0; place < size; place++)
          grown[name].push((values[one * size + place] + values[other * size + place]) / 2);
    }
  };
  for (let triangle = 0; triangle < triangles; triangle++) {
    const [a, b, c] = [0, 1, 2].map((corner) => 3 * triangle + corner);
    const turns = [
      [a, b, c],
      [b, c, a],
      [c, a, b],
    ];
    const long = turns.map(([one, other]) => isLong(one, other));
    const count = long.filter(Boolean).length;
    any ||= count > 0;
    if (count === 0) push([a, a], [b, b], [c, c]);
    else if (count === 3) {
      push([a, a], [a, b], [c, a], [a, b], [b, b], [b, c], [c, a], [b, c], [c, c], [a, b], [b, c], [c, a]);
    } else if (count === 1) {
      const [one, other, third] = turns[long.indexOf(true)];
      push([one, one], [one, other], [third, third], [one, other], [other, other], [third, third]);
    } else {
      // The edge from `third` to `one` is the short one, the first two are long.
      const [one, other, third] = turns[(long.indexOf(false) + 1) % 3];
      push([one, other], [other, other], [other, third]);
      push([one, one], [one, other], [third, third], [one, other], [other, third], [third, third]);
    }
  }
  if (!any) return null;
  return Object.fromEntries(
    names.map((name) => [name, { array: Float32Array.from(grown[name]), size: attributes[name].size }]),
  );
}

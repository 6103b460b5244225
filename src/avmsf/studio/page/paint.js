/** Colors between contacts: what lies there is painted as the nearest of them are, on its own side of a thin wall. */

import { BufferAttribute, BufferGeometry, Vector3 } from "three";
import { PointsBVH } from "three-mesh-bvh";

const NEIGHBORS = 3;

/** Rows and weights of the contacts by which each of many positions is painted. */
export class Paint {
  #position = new Vector3();

  /** `positions` and, where they are known, unit `normals`: x, y, z of each, one after another. */
  constructor(contacts, positions, normals = null) {
    this.contacts = contacts;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(contacts.points, 3));
    this.tree = new PointsBVH(geometry);
    const count = positions.length / 3;
    this.rows = new Uint32Array(NEIGHBORS * count);
    this.weights = new Float32Array(NEIGHBORS * count);
    for (let at = 0; at < count; at++) {
      this.#position.fromArray(positions, 3 * at);
      const near = this.#near(normals && [normals[3 * at], normals[3 * at + 1], normals[3 * at + 2]]);
      const closeness = near.map(({ distance }) => (distance + 1e-3 * contacts.spacing) ** -2);
      const sum = closeness.reduce((total, value) => total + value, 0);
      near.forEach(({ row }, rank) => {
        this.rows[NEIGHBORS * at + rank] = row;
        this.weights[NEIGHBORS * at + rank] = closeness[rank] / sum;
      });
    }
  }

  /** Colors of the contacts, three bytes each, mixed for every position. */
  mix(colors) {
    const mixed = new Float32Array(this.rows.length);
    for (let entry = 0; entry < this.rows.length; entry++) {
      const at = 3 * Math.floor(entry / NEIGHBORS), row = 3 * this.rows[entry], weight = this.weights[entry];
      for (let channel = 0; channel < 3; channel++) mixed[at + channel] += weight * colors[row + channel];
    }
    return mixed;
  }

  /** The contacts nearest to the current position, {row, distance}, all on one side of a thin wall. */
  #near(normal) {
    const { contacts } = this;
    const near = this.#nearest(Infinity, () => true);
    const side = normal ?? contacts.normal(near[0].row);
    if (!side || near.every(({ row }) => contacts.facing(row, side) > 0)) return near;
    const same = this.#nearest(near[0].distance + contacts.wall, (row) => contacts.facing(row, side) > 0);
    return same.length ? same : near;
  }

  #nearest(within, accept) {
    const { tree } = this, { array: rows } = tree.geometry.index, position = this.#position;
    const found = [];
    let farthest = within;
    tree.shapecast({
      boundsTraverseOrder: (box) => box.distanceToPoint(position),
      intersectsBounds: (box, isLeaf, distance) => distance < farthest,
      intersectsPoint: (point, index) => {
        const distance = position.distanceTo(point), row = rows[index];
        if (distance >= farthest || !accept(row)) return;
        const rank = found.findLastIndex((other) => other.distance <= distance) + 1;
        found.splice(rank, 0, { row, distance });
        found.length = Math.min(found.length, NEIGHBORS);
        if (found.length === NEIGHBORS) farthest = found[NEIGHBORS - 1].distance;
      },
    });
    return found;
  }
}

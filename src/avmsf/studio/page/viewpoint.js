/** From where the object is looked at: turned by the pointer, by keys and by what is to be seen. */

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const UPS = { z: [0, 0, 1], y: [0, 1, 0], x: [1, 0, 0] };
/** Directions from the object to the eye, for each axis that may point upwards. */
const EYES = { z: [0.75, -1, 0.85], y: [0.75, 0.85, 1], x: [0.85, 0.75, -1] };

export class Viewpoint {
  /** `redraw` is called whenever what the camera sees is another view. */
  constructor(canvas, redraw) {
    this.canvas = canvas;
    this.redraw = redraw;
    this.camera = new THREE.PerspectiveCamera(35, 1, 0.001, 100);
    this.camera.up.set(...UPS.z);
    // A lamp that goes with the eye: whatever one looks at is lit.
    const lamp = new THREE.DirectionalLight(0xffffff, 1.4);
    lamp.position.set(0.4, 0.6, 1);
    this.camera.add(lamp);
    this.#follow();
  }

  #follow() {
    this.controls?.dispose();
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", this.redraw);
  }

  /** Look at all contacts from above their side, with this axis upwards. */
  look({ center, diagonal }, up) {
    this.up = up;
    this.diagonal = diagonal;
    const distance = (0.62 * diagonal) / Math.sin((this.camera.fov * Math.PI) / 360);
    const fit = Math.max(1, 1 / this.camera.aspect) * distance;
    this.camera.up.set(...UPS[up]);
    this.camera.position.set(...EYES[up]).setLength(fit).add(new THREE.Vector3(...center));
    this.camera.near = fit / 100;
    this.camera.far = fit * 10;
    this.camera.updateProjectionMatrix();
    // The controls take the upward axis when they are made.
    this.#follow();
    this.controls.target.set(...center);
    this.controls.minDistance = diagonal / 20;
    this.controls.maxDistance = fit * 5;
    this.#settle();
  }

  /** Turn about what is looked at by angles, radians: to the right, and up. */
  turn(right, up) {
    this.controls.rotateLeft(-right);
    this.controls.rotateUp(up);
  }

  /** Look from the side on which a position on the object lies, a little from above. */
  face(position) {
    const { target } = this.controls;
    const distance = this.camera.position.distanceTo(target);
    const outward = new THREE.Vector3(...position).sub(target).divideScalar(this.diagonal / 2);
    outward.addScaledVector(this.camera.up, 0.5);
    if (outward.lengthSq() === 0) return;
    this.camera.position.copy(target).add(outward.setLength(distance));
    this.#settle();
  }

  #settle() {
    this.controls.update();
    this.redraw();
  }
}

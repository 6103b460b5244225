/** From where the object is looked at: turned by the pointer, by keys and by what is to be seen. */

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const UPS = { z: [0, 0, 1], y: [0, 1, 0], x: [1, 0, 0] };

export class Viewpoint {
  /** `changed` is called whenever what the camera sees is another view. */
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.changed = changed;
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
    this.controls.addEventListener("change", this.changed);
  }

  /** Look at all of the points of a grid from above their side, with this axis upwards. */
  look({ low, points, diagonal }, up) {
    this.up = up;
    const high = [-Infinity, -Infinity, -Infinity];
    for (let at = 0; at < points.length; at++) high[at % 3] = Math.max(high[at % 3], points[at]);
    const middle = low.map((value, axis) => (value + high[axis]) / 2);
    const away = { z: [0.75, -1, 0.85], y: [0.75, 0.85, 1], x: [0.85, 0.75, -1] }[up];
    const distance = (0.62 * diagonal) / Math.sin((this.camera.fov * Math.PI) / 360);
    const fit = Math.max(1, 1 / this.camera.aspect) * distance;
    this.camera.up.set(...UPS[up]);
    this.camera.position.set(...away).setLength(fit).add(new THREE.Vector3(...middle));
    this.camera.near = fit / 100;
    this.camera.far = fit * 10;
    this.camera.updateProjectionMatrix();
    // The controls take the upward axis when they are made.
    this.#follow();
    this.controls.target.set(...middle);
    this.controls.minDistance = diagonal / 20;
    this.controls.maxDistance = fit * 5;
    this.#settle();
  }

  /** Turn about what is looked at by angles, radians: to the right, and up. */
  turn(right, up) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const toUp = new THREE.Quaternion().setFromUnitVectors(this.camera.up, new THREE.Vector3(0, 1, 0));
    offset.applyQuaternion(toUp);
    const sphere = new THREE.Spherical().setFromVector3(offset);
    sphere.theta += right;
    sphere.phi -= up;
    offset.setFromSpherical(sphere.makeSafe()).applyQuaternion(toUp.invert());
    this.camera.position.copy(this.controls.target).add(offset);
    this.#settle();
  }

  /** Look from the side on which a place of an object lies, a little from above. */
  face(place, diagonal) {
    const { target } = this.controls;
    const distance = this.camera.position.distanceTo(target);
    const outward = new THREE.Vector3(...place).sub(target).divideScalar(diagonal / 2);
    outward.addScaledVector(this.camera.up, 0.5);
    if (outward.lengthSq() === 0) return;
    this.camera.position.copy(target).add(outward.setLength(distance));
    this.#settle();
  }

  #settle() {
    this.controls.update();
    this.changed();
  }
}

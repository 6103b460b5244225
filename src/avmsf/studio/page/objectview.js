/** The object on the screen: turned, pointed at, painted, with marks that follow its surface. */

import * as THREE from "three";

import { element } from "./dom.js";
import { dispose, MeshLayer, PointLayer, SplatLayer } from "./objectlayers.js";
import { Viewpoint } from "./viewpoint.js";

export class ObjectView {
  /** Show a bundle's object in `host`; marks are drawn as elements in `overlay`. */
  static async create(host, overlay, bundle) {
    let renderer;
    try {
      renderer = new THREE.WebGLRenderer({ antialias: bundle.manifest.object.kind !== "gaussians", alpha: true });
    } catch {
      throw new Error("This browser shows no 3D (WebGL is missing or off), so the object is not shown: use the panel.");
    }
    const view = new ObjectView(host, overlay, renderer);
    await view.replace(bundle);
    return view;
  }

  constructor(host, overlay, renderer) {
    this.host = host;
    this.overlay = overlay;
    this.renderer = renderer;
    this.marks = new Map();
    this.scene = new THREE.Scene();
    this.eye = new Viewpoint(renderer.domElement, () => this.redraw());
    this.camera = this.eye.camera;
    this.scene.add(this.camera, new THREE.AmbientLight(0xffffff, 1.9));
    host.append(renderer.domElement);
    new ResizeObserver(() => this.#resize()).observe(host);
    this.#resize();
  }

  get canvas() {
    return this.renderer.domElement;
  }

  /** Show another bundle, from the same viewpoint if its contacts are the same. */
  async replace(bundle) {
    const { contacts } = bundle;
    if (!contacts.count)
      throw new Error("This field has no geometry to show. Add it with `avmsf studio FIELD --object MESH`.");
    const files = ({ object, surface }) => `${object.file} ${surface?.file}`;
    if (this.bundle && contacts.equal(this.contacts) && files(this.bundle.manifest) === files(bundle.manifest)) return;
    this.contacts = contacts;
    const layers = { object: this.#layer(bundle, "object") };
    await layers.object;
    if (this.layer) {
      this.scene.remove(this.layer.object);
      for (const each of Object.values(this.layers)) dispose(await each);
      // A new layer bears no paint, and a legend without paint would tell nothing.
      this.layer = this.painted = null;
      document.getElementById("legend").hidden = true;
    }
    this.layers = layers;
    this.bundle = bundle;
    await this.showAs("object");
    this.eye.look(contacts, "z");
  }

  /** Show the object as its own file has it, "object", or the "surface" that was reconstructed, in the same paint. */
  async showAs(source) {
    const { bundle, layers } = this;
    layers[source] ??= this.#layer(bundle, source);
    let layer;
    try {
      layer = await layers[source];
    } catch (error) {
      delete layers[source];
      throw error;
    }
    if (this.bundle !== bundle) return;
    if (this.layer) this.scene.remove(this.layer.object);
    this.layer = layer;
    this.source = source;
    this.scene.add(layer.object);
    layer.paint(this.painted?.colors ?? null);
    this.redraw();
  }

  async #layer(bundle, source) {
    const { kind, file } = bundle.manifest[source];
    if (kind === "points" || !file) return new PointLayer(this.contacts);
    const bytes = await bundle.read(file);
    if (kind === "mesh") return MeshLayer.load(bytes, this.contacts);
    return SplatLayer.load(bytes, this.contacts, { renderer: this.renderer, onDirty: () => this.redraw() });
  }

  /** What lies under a point of the screen: {row, place, normal}, the nearest contact's row; null beside the object. */
  pick(clientX, clientY) {
    const box = this.canvas.getBoundingClientRect();
    const onScreen = new THREE.Vector2(
      (2 * (clientX - box.left)) / box.width - 1,
      1 - (2 * (clientY - box.top)) / box.height,
    );
    const raycaster = new THREE.Raycaster();
    this.camera.updateMatrixWorld();
    raycaster.setFromCamera(onScreen, this.camera);
    const { ray } = raycaster;
    const place = (this.layer.hit?.(raycaster) ?? this.#hitContacts(ray))?.toArray();
    if (!place) return null;
    const { row } = this.contacts.nearestFacing(place, ray.direction.clone().negate().toArray());
    return { row, place, normal: this.contacts.normal(row) };
  }

  /** Where a ray meets the surface that the contacts stand for: discs as wide as they lie apart. */
  #hitContacts(ray) {
    const radius = 1.5 * this.contacts.spacing;
    const point = new THREE.Vector3();
    let [least, nearest] = [Infinity, null];
    for (let row = 0; row < this.contacts.count; row++) {
      point.fromArray(this.contacts.points, 3 * row);
      const beside = ray.distanceToPoint(point);
      if (beside > radius) continue;
      // Among neighbors on the near side, the one that the ray comes closest to.
      const cost = point.distanceTo(ray.origin) + 3 * beside;
      if (cost < least) [least, nearest] = [cost, point.clone()];
    }
    return nearest;
  }

  /** Where a place is on the screen, in client coordinates, and whether its side of the surface faces the eye. */
  project(place, normal = null) {
    const box = this.canvas.getBoundingClientRect();
    this.camera.updateMatrixWorld();
    const onScreen = new THREE.Vector3(...place).project(this.camera);
    const sight = new THREE.Vector3(...place).sub(this.camera.position);
    return {
      x: box.left + ((onScreen.x + 1) / 2) * box.width,
      y: box.top + ((1 - onScreen.y) / 2) * box.height,
      facing: onScreen.z < 1 && (!normal || sight.dot(new THREE.Vector3(...normal)) < 0),
    };
  }

  /** Paint each contact by its value on a scale; null takes the paint off. */
  paint(values, scale) {
    this.painted = values && { values, colors: scale.colors(values) };
    this.layer.paint(this.painted?.colors ?? null);
    this.redraw();
  }

  /** Let an element follow a place on the surface; the old one of this name goes. */
  mark(name, element, place, normal = null) {
    this.unmark(name);
    this.overlay.append(element);
    this.marks.set(name, { element, place, normal });
    this.redraw();
  }

  /** Mark a place by a dot, an element, with a label if there is one; on the side of the surface that it lies on. */
  markDot(name, dot, place, label = null, normal = this.contacts.outward(place)) {
    const words = label && element("span", { className: "label" }, label);
    this.mark(name, element("div", { className: "mark" }, dot, words), place, normal);
  }

  unmark(name) {
    this.marks.get(name)?.element.remove();
    this.marks.delete(name);
  }

  /** Take off the marks whose names begin so. */
  unmarkAll(start) {
    for (const name of [...this.marks.keys()]) if (name.startsWith(start)) this.unmark(name);
  }

  redraw() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = undefined;
      this.#draw();
    });
  }

  #draw() {
    this.renderer.render(this.scene, this.camera);
    const box = this.overlay.getBoundingClientRect();
    for (const { element, place, normal } of this.marks.values()) {
      const { x, y, facing } = this.project(place, normal);
      element.style.transform = `translate(${x - box.left}px, ${y - box.top}px)`;
      element.classList.toggle("behind", !facing);
    }
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.host;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.redraw();
  }
}

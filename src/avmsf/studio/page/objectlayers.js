/** What an object looks like: its mesh, its Gaussians, or its contacts alone; each can be hit by a ray and painted. */

import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { TessellateModifier } from "three/addons/modifiers/TessellateModifier.js";
import { mergeGeometries, mergeVertices } from "three/addons/utils/BufferGeometryUtils.js";
import { MeshBVH } from "three-mesh-bvh";

import { Paint } from "./paint.js";

/** Brightness of a mesh without a color of its own: a white one is hardly seen on the page's light ground. */
const UNCOLORED_GRAY = 0.42;
/** Share of the light that paint keeps of a Gaussian's own brightness, so that the shape stays to be seen. */
const SHADING = 0.35;
/** Edges of a painted mesh have at least this part of its diagonal, which gives at most some 200,000 triangles. */
const MIN_EDGE_SHARE = 1 / 200;
const MAX_HALVINGS = 30;
/** Of the angle between the normal of a corner and that of its face, 40 degrees, from which on an edge is sharp. */
const MIN_CREASE_COSINE = 0.77;

/** Contacts as round dots. */
export class PointLayer {
  constructor(contacts) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(contacts.points, 3));
    this.colors = new THREE.BufferAttribute(new Uint8Array(contacts.points.length), 3, true);
    geometry.setAttribute("color", this.colors);
    const material = new THREE.PointsMaterial({
      size: 1.7 * contacts.spacing,
      vertexColors: true,
      map: roundDot(),
      alphaTest: 0.5,
    });
    this.object = new THREE.Points(geometry, material);
    this.paint(null);
  }

  paint(colors) {
    if (colors) this.colors.array.set(colors);
    else this.colors.array.fill(150);
    this.colors.needsUpdate = true;
  }
}

/** A dot that is a little darker at its rim. */
function roundDot() {
  const canvas = new OffscreenCanvas(32, 32);
  const context = canvas.getContext("2d");
  context.fillStyle = context.createRadialGradient(16, 16, 0, 16, 16, 16);
  context.fillStyle.addColorStop(0, "#fff");
  context.fillStyle.addColorStop(1, "#a6a6a6");
  context.arc(16, 16, 16, 0, 2 * Math.PI);
  context.fill();
  const map = new THREE.CanvasTexture(canvas);
  map.colorSpace = THREE.SRGBColorSpace;
  return map;
}

/** A mesh, lit; painted, a finer copy of it. */
export class MeshLayer {
  static async load(bytes, contacts) {
    const { scene } = await new GLTFLoader().parseAsync(bytes, "");
    return new MeshLayer(scene, contacts);
  }

  constructor(scene, contacts) {
    this.object = new THREE.Group();
    this.object.add(scene);
    this.contacts = contacts;
    this.scene = scene;
    this.painted = null;
    scene.updateMatrixWorld(true);
    const parts = [];
    scene.traverse((part) => {
      if (!part.isMesh) return;
      const { geometry, material } = part;
      material.side = THREE.DoubleSide;
      // Metal shows only what it mirrors, and there is nothing around the object.
      material.metalness = 0;
      material.roughness = 0.8;
      const { s: saturation, l: lightness } = material.color.getHSL({});
      if (!material.map && !geometry.attributes.color && saturation < 0.05 && lightness > UNCOLORED_GRAY)
        material.color.setScalar(UNCOLORED_GRAY);
      if (!geometry.attributes.normal) geometry.computeVertexNormals();
      const bare = new THREE.BufferGeometry();
      for (const name of ["position", "normal"]) bare.setAttribute(name, geometry.attributes[name].clone());
      bare.setIndex(geometry.index?.clone() ?? null);
      parts.push((bare.index ? bare.toNonIndexed() : bare).applyMatrix4(part.matrixWorld));
    });
    this.geometry = mergeGeometries(parts);
    sharpen(this.geometry);
    this.tree = new MeshBVH(this.geometry, { indirect: true });
  }

  hit({ ray }) {
    return this.tree.raycastFirst(ray, THREE.DoubleSide)?.point ?? null;
  }

  paint(colors) {
    this.scene.visible = !colors;
    if (this.painted) this.painted.visible = Boolean(colors);
    if (!colors) return;
    this.painted ??= this.#finerCopy();
    const attribute = this.painted.geometry.attributes.color;
    attribute.array.set(this.paints.mix(colors).map(toLight));
    attribute.needsUpdate = true;
  }

  /** A copy whose edges are so short that colors of its corners show what the contacts between them have. */
  #finerCopy() {
    const { spacing, diagonal } = this.contacts;
    const longest = Math.max(1.5 * spacing, MIN_EDGE_SHARE * diagonal);
    const finer = new TessellateModifier(longest, MAX_HALVINGS).modify(this.geometry);
    const geometry = mergeVertices(finer, 1e-6 * diagonal);
    const { position, normal } = geometry.attributes;
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(position.array.length), 3));
    this.paints = new Paint(this.contacts, position.array, normal.array);
    const material = new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide });
    const copy = new THREE.Mesh(geometry, material);
    this.object.add(copy);
    return copy;
  }
}

/** Give corners whose normals are far from that of their face the face's: a sharp edge is no round one. */
function sharpen({ attributes: { position, normal } }) {
  const [triangle, face, own] = [new THREE.Triangle(), new THREE.Vector3(), new THREE.Vector3()];
  for (let corner = 0; corner < position.count; corner++) {
    const first = corner - (corner % 3);
    triangle.setFromAttributeAndIndices(position, first, first + 1, first + 2).getNormal(face);
    const cosine = face.dot(own.fromBufferAttribute(normal, corner));
    if (Math.abs(cosine) < MIN_CREASE_COSINE) normal.setXYZ(corner, ...face.multiplyScalar(Math.sign(cosine) || 1));
  }
}

/** Free what a layer holds of the graphics processor. */
export function dispose(layer) {
  layer.object.traverse(({ geometry, material }) => {
    for (const each of [geometry, material, ...Object.values(material ?? {})]) each?.dispose?.();
  });
  layer.dispose?.();
}

/** A byte of the screen's red, green or blue as an amount of light from 0 to 1, as three wants it. */
function toLight(byte) {
  const share = byte / 255;
  return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
}

/** Gaussians, drawn by spark; painted, each keeps a part of its own brightness. */
export class SplatLayer {
  static async load(bytes, contacts, { renderer, onDirty }) {
    const spark = await import("@sparkjsdev/spark");
    const splats = new spark.SplatMesh({ fileBytes: bytes, fileType: spark.SplatFileType.PLY });
    await splats.initialized;
    return new SplatLayer(spark, splats, contacts, new spark.SparkRenderer({ renderer, onDirty }));
  }

  constructor(spark, splats, contacts, sparkRenderer) {
    this.object = new THREE.Group();
    this.object.add(sparkRenderer, splats);
    this.spark = spark;
    this.splats = splats;
    this.contacts = contacts;
    this.sparkRenderer = sparkRenderer;
    this.opacities = null;
  }

  hit(raycaster) {
    return raycaster.intersectObject(this.splats, false)[0]?.point ?? null;
  }

  paint(colors) {
    if (!this.opacities) {
      if (!colors) return;
      this.#readSplats();
    }
    const { rgba, brightness } = this;
    const mixed = colors && this.paints.mix(colors);
    rgba.count = colors ? brightness.length : 0;
    for (let splat = 0; splat < rgba.count; splat++) {
      const light = 1 - SHADING + SHADING * brightness[splat];
      const [red, green, blue] = mixed.subarray(3 * splat);
      rgba.array.set([light * red, light * green, light * blue, this.opacities[splat]], 4 * splat);
    }
    rgba.needsUpdate = true;
    this.splats.updateVersion();
  }

  #readSplats() {
    const centers = [];
    const opacities = [];
    const brightness = [];
    this.splats.forEachSplat((_, center, scales, rotation, opacity, color) => {
      centers.push(center.x, center.y, center.z);
      opacities.push(255 * opacity);
      brightness.push(Math.min(0.3 * color.r + 0.6 * color.g + 0.1 * color.b, 1));
    });
    this.opacities = Uint8Array.from(opacities);
    this.brightness = Float32Array.from(brightness);
    this.paints = new Paint(this.contacts, Float32Array.from(centers));
    this.rgba = new this.spark.RgbaArray();
    this.rgba.ensureCapacity(brightness.length);
    this.splats.splatRgba = this.rgba;
    this.splats.updateGenerator();
  }

  dispose() {
    this.rgba?.dispose();
    this.splats.dispose();
    this.sparkRenderer.dispose?.();
  }
}

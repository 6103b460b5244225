/** What an object looks like: its mesh, its Gaussians, or its contacts alone; each can be hit by a ray and painted. */

import * as THREE from "three";

import { Neighbors } from "./neighbors.js";
import { subdivide } from "./subdivide.js";
import { TriangleTree } from "./triangletree.js";

/** Parts of the light that paint keeps of a Gaussian's own brightness, so that the shape stays to be seen. */
const SHADING = 0.35;

/** Contacts as round dots. */
export class PointLayer {
  constructor(grid, spacing) {
    this.grid = grid;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(grid.points, 3));
    this.colors = new THREE.BufferAttribute(new Uint8Array(grid.points.length), 3, true);
    geometry.setAttribute("color", this.colors);
    const material = new THREE.PointsMaterial({
      size: 1.7 * spacing,
      vertexColors: true,
      map: roundDot(),
      alphaTest: 0.5,
    });
    this.object = new THREE.Points(geometry, material);
    this.paint(null);
  }

  hit() {
    return null;
  }

  paint(colors) {
    if (colors) this.colors.array.set(colors);
    else this.colors.array.fill(150);
    this.colors.needsUpdate = true;
  }

  dispose() {
    this.object.geometry.dispose();
    this.object.material.map.dispose();
    this.object.material.dispose();
  }
}

function roundDot() {
  const size = 32;
  const pixels = new Uint8Array(4 * size * size);
  for (let place = 0; place < size * size; place++) {
    const [x, y] = [(place % size) + 0.5, Math.floor(place / size) + 0.5].map((value) => (2 * value) / size - 1);
    const lit = 255 * (1 - 0.35 * (x * x + y * y));
    pixels.set([lit, lit, lit, x * x + y * y < 1 ? 255 : 0], 4 * place);
  }
  const map = new THREE.DataTexture(pixels, size, size);
  map.colorSpace = THREE.SRGBColorSpace;
  map.needsUpdate = true;
  return map;
}

/** A mesh, lit; painted, a finer copy of it. */
export class MeshLayer {
  static async load(bytes, grid, spacing) {
    const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
    const { scene } = await new GLTFLoader().parseAsync(bytes, "");
    return new MeshLayer(scene, grid, spacing);
  }

  constructor(scene, grid, spacing) {
    this.object = new THREE.Group();
    this.object.add(scene);
    this.grid = grid;
    this.spacing = spacing;
    this.scene = scene;
    this.painted = null;
    scene.updateMatrixWorld(true);
    scene.traverse((part) => {
      if (!part.isMesh) return;
      part.material.side = THREE.DoubleSide;
      // Metal shows but what it mirrors, and there is nothing around the object.
      part.material.metalness = 0;
      part.material.roughness = 0.8;
      if (!part.geometry.attributes.normal) part.geometry.computeVertexNormals();
    });
    this.corners = cornersOf(scene);
    this.tree = new TriangleTree(this.corners.position.array);
  }

  hit({ ray }) {
    const along = this.tree.distance(ray.origin.toArray(), ray.direction.toArray());
    return along === Infinity ? null : ray.at(along, new THREE.Vector3());
  }

  paint(colors) {
    this.scene.visible = !colors;
    if (this.painted) this.painted.visible = Boolean(colors);
    if (!colors) return;
    this.painted ??= this.#finerCopy();
    const attribute = this.painted.geometry.attributes.color;
    attribute.array.set(this.neighbors.mix(colors, toLight));
    attribute.needsUpdate = true;
  }

  #finerCopy() {
    const fine = subdivide(this.corners, 1.5 * this.spacing);
    const geometry = new THREE.BufferGeometry();
    const position = fine.position.array;
    geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
    geometry.setAttribute("normal", new THREE.BufferAttribute(fine.normal.array, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(position.length), 3));
    this.neighbors = new Neighbors(this.grid, position);
    const material = new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide });
    const copy = new THREE.Mesh(geometry, material);
    this.object.add(copy);
    return copy;
  }

  dispose() {
    this.object.traverse((part) => {
      part.geometry?.dispose();
      for (const value of Object.values(part.material ?? {})) if (value?.isTexture) value.dispose();
      part.material?.dispose();
    });
  }
}

/** Positions and normals of all corners of all triangles of a scene, in the world. */
function cornersOf(scene) {
  const parts = [];
  scene.traverse((part) => {
    if (!part.isMesh) return;
    const flat = part.geometry.index ? part.geometry.toNonIndexed() : part.geometry.clone();
    parts.push(flat.applyMatrix4(part.matrixWorld));
  });
  const joined = (name) => {
    const arrays = parts.map(({ attributes }) => attributes[name].array);
    const array = new Float32Array(arrays.reduce((sum, { length }) => sum + length, 0));
    let at = 0;
    for (const values of arrays) {
      array.set(values, at);
      at += values.length;
    }
    return { array, size: 3 };
  };
  return { position: joined("position"), normal: joined("normal") };
}

/** A byte of the screen's red, green or blue as an amount of light from 0 to 1, as three wants it. */
function toLight(byte) {
  const share = byte / 255;
  return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
}

/** Gaussians, drawn by spark; painted, each keeps a part of its own brightness. */
export class SplatLayer {
  static async load(bytes, grid, { renderer, onDirty }) {
    const spark = await import("@sparkjsdev/spark");
    const splats = new spark.SplatMesh({ fileBytes: bytes, fileType: spark.SplatFileType.PLY });
    await splats.initialized;
    return new SplatLayer(spark, splats, grid, new spark.SparkRenderer({ renderer, onDirty }));
  }

  constructor(spark, splats, grid, sparkRenderer) {
    this.object = new THREE.Group();
    this.object.add(sparkRenderer, splats);
    this.spark = spark;
    this.splats = splats;
    this.grid = grid;
    this.sparkRenderer = sparkRenderer;
    this.own = null;
  }

  hit(raycaster) {
    const [first] = raycaster.intersectObject(this.splats, false);
    return first ? first.point : null;
  }

  paint(colors) {
    if (!this.own) {
      if (!colors) return;
      this.#readOwn();
    }
    const { rgba } = this;
    if (!colors) rgba.count = 0;
    else {
      const mixed = this.neighbors.mix(colors);
      for (let splat = 0; splat < this.lightness.length; splat++) {
        const light = 1 - SHADING + SHADING * this.lightness[splat];
        for (let channel = 0; channel < 3; channel++)
          rgba.array[4 * splat + channel] = light * mixed[3 * splat + channel];
        rgba.array[4 * splat + 3] = this.own[splat];
      }
      rgba.count = this.lightness.length;
    }
    rgba.needsUpdate = true;
    this.splats.updateVersion();
  }

  #readOwn() {
    const places = [];
    const opacities = [];
    const lightness = [];
    this.splats.forEachSplat((_, center, scales, turn, opacity, color) => {
      places.push(center.x, center.y, center.z);
      opacities.push(255 * opacity);
      lightness.push(Math.min(0.3 * color.r + 0.6 * color.g + 0.1 * color.b, 1));
    });
    this.own = Uint8Array.from(opacities);
    this.lightness = Float32Array.from(lightness);
    this.neighbors = new Neighbors(this.grid, Float32Array.from(places));
    this.rgba = new this.spark.RgbaArray();
    this.rgba.ensureCapacity(lightness.length);
    this.splats.splatRgba = this.rgba;
    this.splats.updateGenerator();
  }

  dispose() {
    this.rgba?.dispose();
    this.splats.dispose();
    this.sparkRenderer.dispose?.();
  }
}

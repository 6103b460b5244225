/** What an object looks like: its mesh, its Gaussians, or its contacts alone; each can be hit by a ray and painted. */

import * as THREE from "three";

import { subdivide } from "./subdivide.js";

/** Parts of the light that paint keeps of a Gaussian's own brightness, so that the shape stays to be seen. */
const SHADING = 0.35;
const NEIGHBOURS = 3;

/** A layer paints what the contacts nearest to each of its places have: rows and weights of those. */
class Neighbours {
  constructor(grid, places) {
    const count = places.length / 3;
    this.rows = new Uint32Array(NEIGHBOURS * count);
    this.weights = new Float32Array(NEIGHBOURS * count);
    // Corners of neighbouring triangles are one place.
    const known = new Map();
    for (let place = 0; place < count; place++) {
      const [x, y, z] = places.subarray(3 * place, 3 * place + 3);
      const key = `${x},${y},${z}`;
      const earlier = known.get(key);
      if (earlier !== undefined) {
        for (let neighbour = 0; neighbour < NEIGHBOURS; neighbour++) {
          this.rows[NEIGHBOURS * place + neighbour] = this.rows[NEIGHBOURS * earlier + neighbour];
          this.weights[NEIGHBOURS * place + neighbour] = this.weights[NEIGHBOURS * earlier + neighbour];
        }
        continue;
      }
      known.set(key, place);
      const found = grid.nearest(x, y, z, NEIGHBOURS);
      const near = found.map(({ distance }) => 1 / (distance + 1e-3 * grid.cell) ** 2);
      const sum = near.reduce((total, value) => total + value, 0);
      found.forEach(({ row }, neighbour) => {
        this.rows[NEIGHBOURS * place + neighbour] = row;
        this.weights[NEIGHBOURS * place + neighbour] = near[neighbour] / sum;
      });
    }
  }

  /** Bytes of `colours`, three for each contact, mixed for every place. */
  mix(colours) {
    const mixed = new Float32Array(this.rows.length);
    for (let entry = 0; entry < this.rows.length; entry++) {
      const place = Math.floor(entry / NEIGHBOURS);
      for (let channel = 0; channel < 3; channel++)
        mixed[3 * place + channel] += this.weights[entry] * colours[3 * this.rows[entry] + channel];
    }
    return mixed;
  }
}

/** Contacts as round dots. */
export class PointLayer {
  constructor(grid, spacing) {
    this.grid = grid;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(grid.points, 3));
    this.colours = new THREE.BufferAttribute(new Uint8Array(grid.points.length), 3, true);
    geometry.setAttribute("color", this.colours);
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

  paint(colours) {
    if (colours) this.colours.array.set(colours);
    else this.colours.array.fill(150);
    this.colours.needsUpdate = true;
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
  }

  hit(raycaster) {
    const [first] = raycaster.intersectObject(this.scene, true);
    return first ? first.point : null;
  }

  paint(colours) {
    this.scene.visible = !colours;
    if (this.painted) this.painted.visible = Boolean(colours);
    if (!colours) return;
    this.painted ??= this.#finerCopy();
    const attribute = this.painted.geometry.attributes.color;
    const mixed = this.neighbours.mix(colours);
    const colour = new THREE.Color();
    for (let corner = 0; corner < attribute.count; corner++) {
      const [red, green, blue] = mixed.subarray(3 * corner, 3 * corner + 3);
      colour.setRGB(red / 255, green / 255, blue / 255, THREE.SRGBColorSpace);
      attribute.setXYZ(corner, colour.r, colour.g, colour.b);
    }
    attribute.needsUpdate = true;
  }

  #finerCopy() {
    const corners = { position: { array: [], size: 3 }, normal: { array: [], size: 3 } };
    this.scene.traverse((part) => {
      if (!part.isMesh) return;
      const flat = (part.geometry.index ? part.geometry.toNonIndexed() : part.geometry.clone()).applyMatrix4(
        part.matrixWorld,
      );
      for (const name of ["position", "normal"])
        for (const value of flat.attributes[name].array) corners[name].array.push(value);
    });
    const fine = subdivide(corners, 1.5 * this.spacing);
    const geometry = new THREE.BufferGeometry();
    const position = Float32Array.from(fine.position.array);
    geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
    geometry.setAttribute("normal", new THREE.BufferAttribute(Float32Array.from(fine.normal.array), 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(position.length), 3));
    this.neighbours = new Neighbours(this.grid, position);
    const material = new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide });
    const copy = new THREE.Mesh(geometry, material);
    this.object.add(copy);
    return copy;
  }

  dispose() {
    this.object.traverse((part) => {
      part.geometry?.dispose();
      part.material?.dispose();
    });
  }
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

  paint(colours) {
    if (!this.own) {
      if (!colours) return;
      this.#readOwn();
    }
    const { rgba } = this;
    if (!colours) rgba.count = 0;
    else {
      const mixed = this.neighbours.mix(colours);
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
    this.splats.forEachSplat((_, centre, scales, turn, opacity, colour) => {
      places.push(centre.x, centre.y, centre.z);
      opacities.push(255 * opacity);
      lightness.push(Math.min(0.3 * colour.r + 0.6 * colour.g + 0.1 * colour.b, 1));
    });
    this.own = Uint8Array.from(opacities);
    this.lightness = Float32Array.from(lightness);
    this.neighbours = new Neighbours(this.grid, Float32Array.from(places));
    this.rgba = new this.spark.RgbaArray();
    this.rgba.ensureCapacity(lightness.length);
    this.splats.splatRgba = this.rgba;
    this.splats.updateGenerator();
  }

  dispose() {
    this.splats.dispose();
    this.sparkRenderer.dispose?.();
  }
}

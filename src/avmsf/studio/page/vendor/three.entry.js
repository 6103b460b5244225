/*! With three-mesh-bvh, Copyright (c) 2018 Garrett Johnson, MIT License */
export * from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
export { TessellateModifier } from "three/addons/modifiers/TessellateModifier.js";
export { FullScreenQuad, Pass } from "three/addons/postprocessing/Pass.js";
export { mergeGeometries, mergeVertices } from "three/addons/utils/BufferGeometryUtils.js";
export { MeshBVH, PointsBVH } from "three-mesh-bvh";

export * from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
export { FullScreenQuad, Pass } from "three/addons/postprocessing/Pass.js";

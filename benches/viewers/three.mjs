// What three.js makes of GLB files: a line of JSON for each, in the order of the arguments.
import { readFile } from "node:fs/promises";
import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

// What the loader wants of a browser. Images are not decoded, but their bytes must arrive.
globalThis.self = globalThis;
globalThis.createImageBitmap = async (blob) => {
  if (blob.size === 0) throw new Error("an image is empty");
  return { width: 1, height: 1, close() {} };
};
// Its warnings (images that were not loaded, extensions) are failures here.
console.warn = console.error = (...parts) => {
  throw new Error(parts.join(" "));
};

/** Triangles, materials and textures below an object. */
function count(root, associations) {
  const [materials, textures] = [new Set(), new Set()];
  let triangles = 0;
  root.traverse((node) => {
    if (!node.isMesh) return;
    triangles += node.geometry.index.count / 3;
    // The loader copies materials and textures, but knows which of the file they are.
    materials.add(associations.get(node.material)?.materials);
    for (const value of Object.values(node.material)) {
      if (value?.isTexture) textures.add(associations.get(value).textures);
    }
  });
  materials.delete(undefined);
  return { triangles, materials: materials.size, textures: textures.size };
}

async function read(path) {
  const bytes = new Uint8Array(await readFile(path));
  const { scene, parser } = await new GLTFLoader()
    .setMeshoptDecoder(MeshoptDecoder)
    .parseAsync(bytes.buffer, "");
  // Coarser levels are beside the scene: the finest names them.
  const coarser = parser.json.nodes.flatMap((node) => node.extensions?.MSFT_lod?.ids ?? []);
  const others = await Promise.all(coarser.map((id) => parser.getDependency("node", id)));
  return [scene, ...others].map((root) => count(root, parser.associations));
}

for (const path of process.argv.slice(2)) {
  console.log(JSON.stringify(await read(path).catch((error) => ({ problem: error.message }))));
}

// What three.js makes of the splats in GLB files: `node read_splats.mjs FILE ...` prints a JSON list with, of each file, the types of the
// objects in the scene that it opens with, and the splats of all its scenes as three.js would draw them.

import { readFile } from 'node:fs/promises';
import { GLTFGaussianSplatLoaderExtension } from 'three/examples/jsm/loaders/GLTFGaussianSplatLoaderExtension.js';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';

const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
const found = [];
for (const path of process.argv.slice(2)) {
  const bytes = await readFile(path);
  const gltf = await loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength), '');
  const opened = [];
  gltf.scene.traverse((object) => opened.push(object.type));
  const splats = [];
  for (const scene of gltf.scenes) {
    scene.updateMatrixWorld(true);
    scene.traverse((object) => {
      if (!object.isGaussianSplat) return;
      const { attributes } = object.splatGeometry;
      const bytesOf = (name) => [...new Uint8Array(attributes[name].array.buffer)];
      splats.push({
        columns_of_matrix: object.matrixWorld.elements,
        centers: [...attributes.position.array],
        covariances: [...attributes.covariance.array],
        colors: [...attributes.color.array],
        harmonics: [1, 2, 3].map((degree) => bytesOf(`sphericalHarmonics${degree}`)),
      });
    });
  }
  found.push({ opened, splats });
}
console.log(JSON.stringify(found));

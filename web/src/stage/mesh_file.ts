/** Reads an asset's `mesh.glb` into a geometry that the local picture can change, and the mesh at rest. */

import { BufferAttribute, BufferGeometry, Color, type Mesh, type MeshStandardMaterial } from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import type { RestMesh } from '../edit/mesh';

/** World units with z up, as the file's buffers are; its node, which turns them for other programs, is left out. */
export async function loadMesh(url: string): Promise<{ geometry: BufferGeometry; rest: RestMesh }> {
  const gltf = await new GLTFLoader().loadAsync(url);
  const loaded = gltf.scene.getObjectByProperty('isMesh', true) as Mesh;
  const geometry = loaded.geometry as BufferGeometry;
  if (!geometry.getAttribute('normal')) geometry.computeVertexNormals();
  completeVertexMaterials(geometry, loaded.material as MeshStandardMaterial);
  const copy = (name: string) => (geometry.getAttribute(name).array as Float32Array).slice();
  // Attributes may share one buffer in the file (colour and albedo do): ours are written to.
  for (const name of ['position', 'normal', 'color', '_roughness', '_metallic']) geometry.setAttribute(name, new BufferAttribute(copy(name), geometry.getAttribute(name).itemSize));
  geometry.setAttribute('_weight', new BufferAttribute(new Float32Array(geometry.getAttribute('position').count), 1));
  const rest = {
    positions: copy('position'),
    normals: copy('normal'),
    faces: new Uint32Array(geometry.index!.array),
    materials: { albedo: copy('color'), roughness: copy('_roughness'), metallic: copy('_metallic') },
  };
  return { geometry, rest };
}

/** A geometry of its own for the mesh at rest, on the same faces. */
export function restGeometry({ positions, normals, materials }: RestMesh, faces: BufferGeometry['index']): BufferGeometry {
  const geometry = new BufferGeometry().setIndex(faces);
  const count = positions.length / 3;
  const attributes = { position: positions, normal: normals, color: materials.albedo, _roughness: materials.roughness, _metallic: materials.metallic, _weight: new Float32Array(count) };
  for (const [name, values] of Object.entries(attributes)) geometry.setAttribute(name, new BufferAttribute(values, values.length / count));
  return geometry;
}

/** Fill in what a foreign file leaves out, so that one shader serves all. */
function completeVertexMaterials(geometry: BufferGeometry, authored: MeshStandardMaterial): void {
  const count = geometry.getAttribute('position').count;
  const fill = (name: string, values: number[]) => {
    if (geometry.getAttribute(name)) return;
    const array = Float32Array.from({ length: count * values.length }, (_, i) => values[i % values.length]!);
    geometry.setAttribute(name, new BufferAttribute(array, values.length));
  };
  const { r, g, b } = authored.color ?? new Color(0.5, 0.5, 0.5);
  fill('color', [r, g, b]);
  fill('_roughness', [authored.roughness ?? 0.5]);
  fill('_metallic', [authored.metalness ?? 0]);
}

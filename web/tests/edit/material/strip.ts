import type { RestMesh } from '../../../src/edit/mesh';

/** A strip of six vertices along x, two by two; the last two are white, the others black. */
export const strip = (): RestMesh => {
  const white = [0, 0, 0, 0, 1, 1];
  return {
    positions: Float32Array.from([0, 1, 2, 3, 4, 5].flatMap((x) => [x, x % 2, 0])),
    normals: new Float32Array(18),
    faces: Uint32Array.from([0, 1, 2, 1, 2, 3, 2, 3, 4, 3, 4, 5]),
    materials: { albedo: Float32Array.from(white.flatMap((value) => [value, value, value])), roughness: new Float32Array(6).fill(0.5), metallic: new Float32Array(6) },
  };
};

import { expect, it } from 'vitest';
import { applyMaterials, meanMaterial, meshRegions, selectVertices, type RestMesh } from '../src/materials';
import type { Edit, Selection } from '../src/protocol.gen';

/** A strip of six vertices along x, two by two; the last two are white, the others black. */
const strip = (): RestMesh => {
  const white = [0, 0, 0, 0, 1, 1];
  return {
    positions: Float32Array.from([0, 1, 2, 3, 4, 5].flatMap((x) => [x, x % 2, 0])),
    normals: new Float32Array(18),
    faces: Uint32Array.from([0, 1, 2, 1, 2, 3, 2, 3, 4, 3, 4, 5]),
    materials: { albedo: Float32Array.from(white.flatMap((value) => [value, value, value])), roughness: new Float32Array(6).fill(0.5), metallic: new Float32Array(6) },
  };
};
const weights = (select: Selection) => [...selectVertices(strip(), select)];

it('regions are patches without a jump in material, the largest first', () => {
  expect([...meshRegions(strip())]).toEqual([0, 0, 0, 0, 1, 1]);
  expect(weights({ region: 1 })).toEqual([0, 0, 0, 0, 1, 1]);
});

it('similar floods over what is within the tolerance of the picked vertex', () => {
  expect(weights({ similar: { point: [4.9, 1, 0] } })).toEqual([0, 0, 0, 0, 1, 1]);
  expect(weights({ similar: { point: [0, 0, 0], tolerance: 1 } })).toEqual([1, 1, 1, 1, 0, 0]);
});

it('spheres and boxes fall off smoothly outside', () => {
  const [first, second, third] = weights({ sphere: { center: [0, 0, 0], radius: 1, falloff: 2 } });
  expect(first).toBe(1);
  expect(second).toBeCloseTo((() => { const t = 1 - (Math.SQRT2 - 1) / 2; return t * t * (3 - 2 * t); })(), 6);
  expect(third).toBeCloseTo(0.5, 6); // half way through the rim
  expect(weights({ box: { minimum: [0, 0, 0], maximum: [2, 1, 0] } })).toEqual([1, 1, 1, 0, 0, 0]);
});

it('edits apply in order: absolute by weight, multiply with a limit', () => {
  const edits: Edit[] = [
    { op: 'material', select: { vertex_weights: [0.5, 0, 0, 0, 0, 0] }, set: { roughness: 1 } },
    { op: 'material', select: { all: true }, set: { roughness: 1.6 }, mode: 'multiply' },
  ];
  const { roughness } = applyMaterials(strip(), edits);
  expect(roughness[0]).toBe(1);
  expect(roughness[1]).toBeCloseTo(0.8, 6);
});

it('without edits the captured arrays themselves come back', () => {
  const mesh = strip();
  expect(applyMaterials(mesh, [{ op: 'environment' }])).toBe(mesh.materials);
});

it('means are weighted, and absent where nothing is selected', () => {
  const mesh = strip();
  expect(meanMaterial(mesh.materials, selectVertices(mesh, { region: 1 }))).toEqual({ albedo: [1, 1, 1], roughness: 0.5, metallic: 0 });
  expect(meanMaterial(mesh.materials, new Float32Array(6))).toBe(null);
});

import { expect, it } from 'vitest';
import { applyMaterials, meanMaterial } from '../../../src/edit/material/apply_materials';
import { selectVertices } from '../../../src/edit/material/select_vertices';
import type { Edit } from '../../../src/session/protocol.gen';
import { strip } from './strip';

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

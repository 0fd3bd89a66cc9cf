import { expect, it } from 'vitest';
import { describeEdit } from '../../src/edit/describe_edit';

it('history names presets and parts', () => {
  expect(describeEdit({ op: 'material', select: { all: null, sphere: null, box: null, region: 2, similar: null, vertex_weights: null }, set: { albedo: [1.0, 0.766, 0.336], roughness: 0.2, metallic: 1 } })).toBe('Region: gold');
  expect(describeEdit({ op: 'material', select: { all: true }, set: { roughness: 0.25 } })).toBe('Roughness 0.25');
});

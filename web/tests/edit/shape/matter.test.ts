import { expect, it } from 'vitest';
import { density, dropHeight, hasFloor, matter, pins, poisson, seconds, stiffness } from '../../../src/edit/shape/matter';
import { mesh } from '../../../src/edit/mesh';
import { difference } from '../../../src/session/edit_list';
import { log, resetLog } from '../../../src/session/edit_log';
import type { Edit } from '../../../src/session/protocol.gen';

const matterEdit = (scene: Record<string, unknown>): Edit => ({ op: 'matter', scene });
const inForce = (...edits: Edit[]) => resetLog({ ...log.value, edits });

it('the panel shows what the session says, and what a matter is like until somebody says so', () => {
  mesh.value = { positions: new Float32Array([0, 0, -1, 0, 0, 3]), normals: new Float32Array(6), faces: new Uint32Array(), materials: { albedo: new Float32Array(6), roughness: new Float32Array(2), metallic: new Float32Array(2) } };
  inForce();
  expect([matter.value, stiffness.value, density.value, poisson.value, hasFloor.value, dropHeight.value, seconds.value, pins.value]).toEqual(['jelly', null, null, null, true, 0.5, 1.5, []]);
  inForce(matterEdit({ matter: { preset: 'clay', density: 2000, young_modulus: 10_000, poisson_ratio: 0.4 }, floor: { height: -5, friction: 0.5 }, pins: [1], duration: 3 }));
  expect([matter.value, stiffness.value, poisson.value, dropHeight.value, seconds.value, pins.value]).toEqual(['clay', 1, 0.4, 1, 3, [1]]);
  expect(density.value).toBeCloseTo(Math.log10(2));
  inForce(matterEdit({ matter: { law: 'fluid' }, floor: null }));
  expect([matter.value, hasFloor.value]).toEqual(['jelly', false]);
});

it('a scene that leaves out what another says is another scene', () => {
  const [set, unset] = [matterEdit({ matter: { preset: 'jelly', density: 2000 } }), matterEdit({ matter: { preset: 'jelly' } })];
  expect(difference([set], [unset]).edits).toEqual([unset]);
  expect(difference([set], [matterEdit({ matter: { preset: 'jelly', density: 2000 } })])).toEqual({ start: 1, remove: 0, edits: [] });
});

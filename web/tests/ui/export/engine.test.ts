import { expect, it } from 'vitest';
import { Quat, Vec3 } from '../../../src/ui/export/splats/engine';

const numbers = (v: Vec3) => [v.x, v.y, v.z].map((value) => Math.round(1e6 * value) / 1e6 + 0); // no -0

it('turns by degrees around axes that stand still, x first', () => {
  const turn = new Quat().setFromEulerAngles(90, 0, 90);
  expect(numbers(turn.transformVector(new Vec3(0, 1, 0), new Vec3()))).toEqual([0, 0, 1]);
  expect(numbers(turn.transformVector(new Vec3(1, 0, 0), new Vec3()))).toEqual([0, 1, 0]);
});

it('a turn and its inverse leave everything where it is', () => {
  const turn = new Quat().setFromEulerAngles(0, 0, 180);
  const back = new Quat().mul2(turn.clone().invert(), turn);
  expect([back.x, back.y, back.z, back.w]).toEqual([0, 0, 0, 1]);
  expect(numbers(turn.transformVector(new Vec3(1, 2, 3), new Vec3()).mulScalar(2))).toEqual([-2, -4, 6]);
});

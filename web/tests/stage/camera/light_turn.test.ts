import { Euler, Matrix4, Vector3 } from 'three';
import { expect, test } from 'vitest';
import type { Vec3 } from '../../../src/session/view';
import { lightTurn } from '../../../src/stage/camera/light_turn';

const first = new Matrix4().makeRotationFromEuler(new Euler(0.3, -0.8, 1.1));
const rows = [0, 1, 2].map((row) => [0, 4, 8].map((column) => first.elements[column + row]) as unknown as Vec3);

test('before the first camera, wherever it stands, light is as its table has it', () => {
  const moved = first.clone().setPosition(1, 2, 3);
  const turn = lightTurn(rows, moved);
  new Matrix4().elements.forEach((one, i) => expect(turn.elements[i]).toBeCloseTo(one, 6));
});

test('what comes from behind the camera does so for every camera', () => {
  const other = new Matrix4().makeRotationFromEuler(new Euler(-1.2, 0.4, 0.2));
  const [behindFirst, behindOther] = [first, other].map((worldFromCamera) => new Vector3(0, 0, 1).transformDirection(worldFromCamera));
  const looked = behindOther!.clone().transformDirection(lightTurn(rows, other));
  expect(looked.distanceTo(behindFirst!)).toBeLessThan(1e-6);
});

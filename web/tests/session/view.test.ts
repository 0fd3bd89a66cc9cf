import { Vector3 } from 'three';
import { expect, it } from 'vitest';
import { aimOf, viewOf } from '../../src/session/view';
import { worldFromCamera } from '../../src/stage/camera/camera_path';
import { cameraAt } from '../stage/camera/camera_at';

it('a view is an OpenGL camera-to-world in rows: right, up, backward, place', () => {
  const { world_from_camera, fov_y_degrees, width, height } = viewOf(cameraAt([5, 0, 1], [0, 0, 1]), { width: 640, height: 480 });
  // Seen from +x with z up, right is +y.
  const wanted = [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 1]];
  world_from_camera.forEach((row, i) => row.forEach((value, k) => expect(value).toBeCloseTo(wanted[i]![k]!, 12)));
  expect([fov_y_degrees, width, height]).toEqual([40, 640, 480]);
});

it('a point goes through the rows of a view to where three.js draws it', () => {
  const camera = cameraAt([1.5, -2.1, 1.3], [0.1, 0.2, 0]);
  const { world_from_camera: rows, fov_y_degrees } = viewOf(camera, { width: 400, height: 300 });
  const point = [0.4, -0.3, 0.7];
  const local = [0, 1, 2].map((axis) => point.reduce((sum, value, i) => sum + rows[i]![axis]! * (value - rows[i]![3]), 0));
  const focal = 1 / Math.tan((fov_y_degrees * Math.PI) / 360);
  const drawn = new Vector3(...(point as [number, number, number])).project(camera);
  expect((focal * local[1]!) / -local[2]!).toBeCloseTo(drawn.y, 9);
  expect((focal * local[0]! * 300) / 400 / -local[2]!).toBeCloseTo(drawn.x, 9);
});

it('an aim becomes the matrix of the camera that stands and looks so', () => {
  const [eye, target] = [[1.5, -2.1, 1.3], [0.1, 0.2, 0]] as [number, number, number][];
  const seen = viewOf(cameraAt(eye!, target!), { width: 1, height: 1 }).world_from_camera;
  worldFromCamera({ eye: eye!, target: target!, fov_y_degrees: 40 }).forEach((row, i) => row.forEach((value, k) => expect(value).toBeCloseTo(seen[i]![k]!, 9)));
});

it('the aim of a view looks the same way, at the point of its axis that is nearest to a given one', () => {
  const view = viewOf(cameraAt([3, -2, 1.5], [0.2, 0.1, 0.4]), { width: 64, height: 48 });
  aimOf(view, [0.2, 0.1, 0.4]).target.forEach((value, i) => expect(value).toBeCloseTo([0.2, 0.1, 0.4][i]!, 9));
  const beside = aimOf(view, [0.3, 0.2, 0.9]);
  worldFromCamera(beside).flat().forEach((value, i) => expect(value).toBeCloseTo(view.world_from_camera.flat()[i]!, 9));
});

import { expect, it } from 'vitest';
import { asTransforms, pathFrames, viewAt, worldFromCamera } from '../../../src/stage/camera/camera_path';
import stored from './camera_path.json';
import storedClosed from './camera_path_closed.json';

type Vector = [number, number, number];
type Keyframes = { eye: Vector; target: Vector; fov_y_degrees?: number; seconds: number }[];
const keyframes = stored.keyframes as Keyframes;

it.each([
  ['open', stored],
  ['closed', storedClosed],
])('the preview of an %s path shows what a worker renders: the same numbers as in Python', (kind, { fps, views, ...path }) => {
  const closed = kind === 'closed';
  const given = path.keyframes as Keyframes;
  expect(pathFrames(given, fps, closed)).toBe(views.length);
  views.forEach((wanted, k) => {
    const seen = viewAt(given, k / fps, closed);
    worldFromCamera(seen).flat().forEach((value, i) => expect(value).toBeCloseTo(wanted.world_from_camera.flat()[i]!, 9));
    expect(seen.fov_y_degrees).toBeCloseTo(wanted.fov_y_degrees, 9);
  });
});

it('before the first and behind the last view stands the camera still', () => {
  expect(viewAt(keyframes, -1, false)).toEqual(viewAt(keyframes, 0, false));
  expect(viewAt(keyframes, 1000, false)).toEqual(viewAt(keyframes, keyframes.slice(1).reduce((sum, { seconds }) => sum + seconds, 0), false));
  const [alone] = keyframes;
  viewAt([alone!], 5, true).eye.forEach((value, i) => expect(value).toBeCloseTo(alone!.eye[i]!, 12));
});

it('cameras are saved as the file that drgs render reads', () => {
  const { w, h, cx, frames } = JSON.parse(asTransforms(keyframes, 4, { width: 640, height: 360 }, false));
  expect([w, h, cx, frames.length, frames[3].file_path]).toEqual([640, 360, 320, stored.views.length, '0003']);
  expect(frames[0].fl_x).toBeCloseTo(180 / Math.tan((20 * Math.PI) / 180), 9);
  expect(frames[3].transform_matrix).toEqual(worldFromCamera(viewAt(keyframes, 3 / 4, false)));
});

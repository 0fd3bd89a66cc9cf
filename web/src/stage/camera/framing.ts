/** From where an object fills what panels leave of the window. */

import { Vector2, Vector3, type Box3, type PerspectiveCamera } from 'three';
import { freeArea } from './free_area';

/** Room around a framed object: 1 is none. */
const MARGIN = 1.06;

/**
 * Camera on the side of `direction` of the box's centre, as near as it can be with every corner in the free part; `focalOffset` moves
 * the picture there.
 *
 * A corner at (r, u, t) of the camera's axes, t towards it, is left of the free part's right edge R where r - a <= R (d - t), with a the
 * camera's shift and d its distance. All such bounds are linear in a and d, so the extreme corners give both.
 */
export function frameBox(box: Box3, direction: Vector3, camera: PerspectiveCamera, window: { width: number; height: number }): { eye: Vector3; center: Vector3; focalOffset: Vector2 } {
  const tangent = Math.tan((camera.fov * Math.PI) / 360); // of half the height
  const free = freeArea(window.width, window.height);
  const center = box.getCenter(new Vector3());
  const back = direction.clone().normalize();
  const right = new Vector3().crossVectors(camera.up, back).normalize();
  const up = new Vector3().crossVectors(back, right);
  const corners = Array.from({ length: 8 }, (_, corner) => {
    const { min, max } = box;
    return new Vector3(corner & 1 ? max.x : min.x, corner & 2 ? max.y : min.y, corner & 4 ? max.z : min.z).sub(center);
  });
  const toward = corners.map((corner) => corner.dot(back));
  /** Along one axis of the picture, whose edges are tangents of angles: the least distance, and the shift at any distance from there on. */
  const bounds = (axis: Vector3, low: number, high: number) => {
    const above = Math.max(...corners.map((corner, i) => corner.dot(axis) + high * toward[i]!));
    const below = Math.max(...corners.map((corner, i) => -corner.dot(axis) - low * toward[i]!));
    return { distance: (above + below) / (high - low), shift: (distance: number) => (above - below - (high + low) * distance) / 2 };
  };
  const perPixel = (2 * tangent) / window.height;
  const half = { x: (0.5 * free.width * perPixel) / MARGIN, y: (0.5 * free.height * perPixel) / MARGIN };
  const middle = { x: (free.x - window.width / 2) * perPixel, y: (window.height / 2 - free.y) * perPixel };
  const across = bounds(right, middle.x - half.x, middle.x + half.x);
  const upward = bounds(up, middle.y - half.y, middle.y + half.y);
  const distance = Math.max(across.distance, upward.distance);
  return { eye: back.multiplyScalar(distance).add(center), center, focalOffset: new Vector2(across.shift(distance), -upward.shift(distance)) };
}

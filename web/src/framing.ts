/** From where an object fills what panels leave of the window. */

import { Vector2, Vector3, type Box3, type PerspectiveCamera } from 'three';
import { freeArea } from './free_area';

/** Room around a framed object: 1 is none. */
const MARGIN = 1.06;

/** Camera on the side of `direction` of the box's centre; `focalOffset` moves the centre to the middle of the free part. */
export function frameBox(box: Box3, direction: Vector3, camera: PerspectiveCamera, window: { width: number; height: number }): { eye: Vector3; center: Vector3; focalOffset: Vector2 } {
  const { width, height } = window;
  const free = freeArea(width, height);
  const tangent = Math.tan((camera.fov * Math.PI) / 360); // of half the height
  const center = box.getCenter(new Vector3());
  const back = direction.clone().normalize();
  const right = new Vector3().crossVectors(camera.up, back).normalize();
  const up = new Vector3().crossVectors(back, right);
  let distance = 0;
  for (let corner = 0; corner < 8; corner++) {
    const { min, max } = box;
    const p = new Vector3(corner & 1 ? max.x : min.x, corner & 2 ? max.y : min.y, corner & 4 ? max.z : min.z).sub(center);
    const across = Math.max(Math.abs(p.dot(right)) / free.width, Math.abs(p.dot(up)) / free.height);
    distance = Math.max(distance, p.dot(back) + (MARGIN * across * height) / tangent);
  }
  const unitsPerPixel = (2 * tangent * distance) / height;
  const focalOffset = new Vector2((width / 2 - free.x) * unitsPerPixel, (height / 2 - free.y) * unitsPerPixel);
  return { eye: back.multiplyScalar(distance).add(center), center, focalOffset };
}

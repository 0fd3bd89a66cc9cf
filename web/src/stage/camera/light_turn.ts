/** How light that stands still with the camera turns against the world. */

import { Matrix4 } from 'three';
import type { Vec3 } from '../../session/view';

/**
 * Rotation of directions in the world to those of the light's table, as drgs' `light_from_world` has it.
 * `first`: rows of the rotation of the camera before which they are the same, world from camera.
 */
export function lightTurn(first: readonly Vec3[], worldFromCamera: Matrix4): Matrix4 {
  const [x, y, z] = first as [Vec3, Vec3, Vec3];
  const worldFromFirst = new Matrix4().set(...x, 0, ...y, 0, ...z, 0, 0, 0, 0, 1);
  return worldFromFirst.multiply(new Matrix4().extractRotation(worldFromCamera).transpose());
}

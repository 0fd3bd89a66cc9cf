/** The speed of the flying camera. */

import { Vector3, type PerspectiveCamera } from 'three';

/** In object radii a second; shift makes it so many times faster, alt slower. */
const SPEED = 0.8;
const FACTOR = 4;

/** How far the held keys move the camera in that time, in a world where the object has this radius. */
export function flightStep(held: ReadonlySet<string>, camera: PerspectiveCamera, radius: number, seconds: number): Vector3 {
  const has = (...codes: string[]) => (codes.some((code) => held.has(code)) ? 1 : 0);
  const faster = has('ShiftLeft', 'ShiftRight') ? FACTOR : has('AltLeft', 'AltRight') ? 1 / FACTOR : 1;
  const step = SPEED * faster * radius * Math.min(seconds, 0.1);
  const move = camera.getWorldDirection(new Vector3()).multiplyScalar((has('KeyW') - has('KeyS')) * step);
  move.addScaledVector(new Vector3().setFromMatrixColumn(camera.matrixWorld, 0), (has('KeyD') - has('KeyA')) * step);
  return move.addScaledVector(camera.up, (has('KeyE') - has('KeyQ')) * step);
}

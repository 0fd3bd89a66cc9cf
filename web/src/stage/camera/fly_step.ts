/** The speed of the flying camera. */

import { Vector3, type PerspectiveCamera } from 'three';

/** In object radii a second. */
const SPEED = 0.8;
/** Shift makes it so many times faster, alt slower. */
const FACTOR = 4;
/** After a pause of the page the camera must not jump [s]. */
const LONGEST_STEP = 0.1;

/** How far the held keys (`KeyboardEvent.code`) move the camera [world units]; `radius`: of the object. */
export function flyStep(held: ReadonlySet<string>, camera: PerspectiveCamera, radius: number, seconds: number): Vector3 {
  const has = (...codes: string[]) => (codes.some((code) => held.has(code)) ? 1 : 0);
  const faster = has('ShiftLeft', 'ShiftRight') ? FACTOR : has('AltLeft', 'AltRight') ? 1 / FACTOR : 1;
  const step = SPEED * faster * radius * Math.min(seconds, LONGEST_STEP);
  const move = camera.getWorldDirection(new Vector3()).multiplyScalar((has('KeyW') - has('KeyS')) * step);
  move.addScaledVector(new Vector3().setFromMatrixColumn(camera.matrixWorld, 0), (has('KeyD') - has('KeyA')) * step);
  return move.addScaledVector(camera.up, (has('KeyE') - has('KeyQ')) * step);
}

import { PerspectiveCamera } from 'three';

/** A camera with z up, its matrices up to date. */
export function cameraAt(eye: [number, number, number], target: [number, number, number]): PerspectiveCamera {
  const camera = new PerspectiveCamera(40, 4 / 3, 0.01, 100);
  camera.up.set(0, 0, 1);
  camera.position.set(...eye);
  camera.lookAt(...target);
  camera.updateMatrixWorld();
  return camera;
}

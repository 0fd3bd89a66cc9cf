/** Holds the camera at a view of the capture, and afterwards gives it back to the controls where it was. */

import type CameraControls from 'camera-controls';
import { Matrix4, Quaternion, Vector3, type PerspectiveCamera, type Sphere } from 'three';
import { photographPlace, placeView, viewInSight } from '../../capture/photographs';
import type { TrainingView } from '../../session/protocol.gen';
import { freeEdges } from './free_area';

const FLIGHT_MS = 320;

interface Pose {
  position: Vector3;
  turn: Quaternion;
  fov: number;
}

export class LookThrough {
  private view: TrainingView | null = null;
  /** The camera's place before it looked through the first view. */
  private before: { eye: Vector3; target: Vector3; focalOffset: Vector3; fov: number } | null = null;
  private from: Pose | null = null;
  private startedAt = 0;
  /** Names the view, the share of the flight and the place of the last picture: nothing is done twice. */
  private reached = '';

  constructor(
    private readonly stage: HTMLElement,
    private readonly camera: PerspectiveCamera,
    private readonly controls: CameraControls,
    private readonly bounds: Sphere,
    private readonly flightMs: number = FLIGHT_MS,
  ) {}

  /** Once each animation frame: whether the camera moved; null where it is left to the controls. */
  apply(now: number): boolean | null {
    const view = viewInSight.value;
    if (!view) return this.leave();
    const { camera, controls } = this;
    this.before ??= { eye: controls.getPosition(new Vector3()), target: controls.getTarget(new Vector3()), focalOffset: controls.getFocalOffset(new Vector3()), fov: camera.fov };
    if (view !== this.view) {
      this.view = view;
      this.from = { position: camera.position.clone(), turn: camera.quaternion.clone(), fov: camera.fov };
      this.startedAt = now;
    }
    const window = { width: this.stage.clientWidth, height: this.stage.clientHeight };
    const { fovDegrees, place } = placeView(view, window, freeEdges(window.width, window.height));
    const share = this.flightMs > 0 ? Math.min(1, (now - this.startedAt) / this.flightMs) : 1;
    const key = `${view.name} ${share} ${Object.values(place).join()}`;
    if (key === this.reached) return false;
    this.reached = key;
    const world = new Matrix4().set(...(view.world_from_camera.flat() as Parameters<Matrix4['set']>));
    this.put({ position: new Vector3().setFromMatrixPosition(world), turn: new Quaternion().setFromRotationMatrix(world), fov: fovDegrees }, share);
    photographPlace.value = share < 1 ? null : place;
    return true;
  }

  /** Put the camera a share of the way to a view, round the object rather than through it. */
  private put(to: Pose, share: number): void {
    const { camera, bounds } = this;
    const from = this.from!;
    const eased = share * share * (3 - 2 * share);
    if (share < 1) {
      const [a, b] = [from.position, to.position].map((position) => position.clone().sub(bounds.center)) as [Vector3, Vector3];
      const round = new Quaternion().slerp(new Quaternion().setFromUnitVectors(a.clone().normalize(), b.clone().normalize()), eased);
      const distance = a.length() + eased * (b.length() - a.length());
      camera.position.copy(a.normalize().applyQuaternion(round).multiplyScalar(distance).add(bounds.center));
      camera.quaternion.slerpQuaternions(from.turn, to.turn, eased);
    } else {
      camera.position.copy(to.position);
      camera.quaternion.copy(to.turn);
    }
    camera.fov = from.fov + eased * (to.fov - from.fov);
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }

  private leave(): true | null {
    if (!this.before) return null;
    const { eye, target, focalOffset, fov } = this.before;
    void this.controls.setLookAt(...eye.toArray(), ...target.toArray(), false);
    void this.controls.setFocalOffset(...focalOffset.toArray(), false);
    this.camera.fov = fov;
    this.camera.updateProjectionMatrix();
    this.controls.update(0);
    this.before = this.view = null;
    this.reached = '';
    photographPlace.value = null;
    return true;
  }
}

/** The flying camera: W A S D move, Q and E sink and rise, dragging turns the head. */

import CameraControls from 'camera-controls';
import { Vector3, type PerspectiveCamera, type Sphere } from 'three';
import { flightStep } from './flight_step';
import { flying } from './state';

/** Physical keys, so that they lie together on every keyboard. */
const CODES = ['KeyW', 'KeyA', 'KeyS', 'KeyD', 'KeyQ', 'KeyE'];

export class Flight {
  private readonly held = new Set<string>();
  private on = false;

  constructor(
    private readonly camera: PerspectiveCamera,
    private readonly controls: CameraControls,
    private readonly bounds: Sphere,
  ) {
    window.addEventListener('keydown', (event) => {
      const typing = event.target instanceof HTMLElement && event.target.matches('input, textarea, select');
      if (!this.on || typing || event.ctrlKey || event.metaKey || !(CODES.includes(event.code) || /^(Shift|Alt)/.test(event.code))) return;
      this.held.add(event.code);
      event.preventDefault();
    });
    window.addEventListener('keyup', (event) => this.held.delete(event.code));
    window.addEventListener('blur', () => this.held.clear());
  }

  /** Start or end, from where the camera is. */
  turn(on: boolean): void {
    if (on === this.on) return;
    this.on = on;
    this.held.clear();
    const { camera, controls, bounds } = this;
    const eye = camera.position.clone();
    const forward = camera.getWorldDirection(new Vector3());
    // Orbiting at no distance turns the head; dragging the picture then is the other way round.
    const distance = on ? 1e-4 * bounds.radius : Math.max(0.3 * bounds.radius, bounds.center.clone().sub(eye).dot(forward));
    controls.minDistance = on ? distance : 0.05 * bounds.radius;
    controls.maxDistance = on ? distance : 60 * bounds.radius;
    controls.azimuthRotateSpeed = controls.polarRotateSpeed = on ? -0.3 : 1;
    // The wheel's step would be a share of no distance.
    controls.mouseButtons.wheel = on ? CameraControls.ACTION.NONE : CameraControls.ACTION.DOLLY;
    const target = eye.clone().addScaledVector(forward, distance);
    void controls.setFocalOffset(0, 0, 0, false);
    void controls.setLookAt(eye.x, eye.y, eye.z, target.x, target.y, target.z, false);
  }

  /** Once each animation frame. */
  move(seconds: number): void {
    if (!flying.value || this.held.size === 0) return;
    const target = this.controls.getTarget(new Vector3()).add(flightStep(this.held, this.camera, this.bounds.radius, seconds));
    void this.controls.moveTo(target.x, target.y, target.z, true);
  }
}

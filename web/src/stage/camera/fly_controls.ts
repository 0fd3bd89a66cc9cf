/** The flying camera: W A S D move, Q and E sink and rise, dragging turns the head. */

import CameraControls from 'camera-controls';
import { Vector3, type PerspectiveCamera, type Sphere } from 'three';
import { flyStep } from './fly_step';

/** Physical keys, so that they lie together on every keyboard. */
const CODES = ['KeyW', 'KeyA', 'KeyS', 'KeyD', 'KeyQ', 'KeyE'];

export class FlyControls {
  private readonly held = new Set<string>();
  private active = false;

  constructor(
    private readonly camera: PerspectiveCamera,
    private readonly controls: CameraControls,
    private readonly bounds: Sphere,
  ) {
    window.addEventListener('keydown', (event) => {
      const typing = event.target instanceof HTMLElement && event.target.matches('input, textarea, select');
      if (!this.active || typing || event.ctrlKey || event.metaKey || !(CODES.includes(event.code) || /^(Shift|Alt)/.test(event.code))) return;
      this.held.add(event.code);
      event.preventDefault();
    });
    window.addEventListener('keyup', (event) => this.held.delete(event.code));
    window.addEventListener('blur', () => this.held.clear());
  }

  /** Begin or end, from where the camera is. */
  setActive(active: boolean): void {
    if (active === this.active) return;
    this.active = active;
    this.held.clear();
    const { camera, controls, bounds } = this;
    const eye = camera.position.clone();
    const forward = camera.getWorldDirection(new Vector3());
    // Orbiting at no distance turns the head, which drags the picture the other way.
    const distance = active ? 1e-4 * bounds.radius : Math.max(0.3 * bounds.radius, bounds.center.clone().sub(eye).dot(forward));
    controls.minDistance = active ? distance : 0.05 * bounds.radius;
    controls.maxDistance = active ? distance : 60 * bounds.radius;
    controls.azimuthRotateSpeed = controls.polarRotateSpeed = active ? -0.3 : 1;
    // The wheel's step would be a share of no distance.
    controls.mouseButtons.wheel = active ? CameraControls.ACTION.NONE : CameraControls.ACTION.DOLLY;
    const target = eye.clone().addScaledVector(forward, distance);
    void controls.setFocalOffset(0, 0, 0, false);
    void controls.setLookAt(eye.x, eye.y, eye.z, target.x, target.y, target.z, false);
  }

  /** Once each animation frame. */
  update(seconds: number): void {
    if (!this.active || this.held.size === 0) return;
    const target = this.controls.getTarget(new Vector3()).add(flyStep(this.held, this.camera, this.bounds.radius, seconds));
    void this.controls.moveTo(target.x, target.y, target.z, true);
  }
}

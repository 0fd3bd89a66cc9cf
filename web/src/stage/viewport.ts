/**
 * The window on the object: the camera and what moves it, the traced picture, and the local picture under it.
 *
 * The traced picture is `fresh` when it shows the newest camera and the newest edits. With the local picture on, a stale traced
 * picture is hidden and a fresh one fades in; without it the newest traced picture always stays.
 */

import { effect, untracked } from '@preact/signals';
import CameraControls from 'camera-controls';
import { Box3, Matrix4, MOUSE, PerspectiveCamera, Quaternion, Raycaster, Sphere, Spherical, Vector2, Vector3, Vector4 } from 'three';
import { viewNumber } from '../capture/photographs';
import { tool } from '../edit/material/selection';
import { shapeTool } from '../edit/shape/shape_tools';
import { edits } from '../session/edit_log';
import { MAX_PIXELS, MAX_SIDE, type FrameHeader, type ServerHello } from '../session/protocol.gen';
import { holdFrames, listen, openedAsset, sendCamera, session, settings } from '../session/session';
import { aimNow, aimOf, viewNow, viewOf, wantedAim, type View } from '../session/view';
import { FlyControls } from './camera/fly_controls';
import { frameBox } from './camera/framing';
import { freeArea } from './camera/free_area';
import { LookThrough } from './camera/look_through';
import { screenPixelRatio } from './dynamic_resolution';
import { FrameLoop } from './frame_loop';
import { Gizmo } from './gizmo';
import { LocalLayer } from './local_layer';
import { PointerTools } from './pointer_tools';
import { listenToPointers } from './pointers';
import { before, flying, localPicture, resolution } from './switches';
import { TracedPicture } from './traced_picture';

CameraControls.install({ THREE: { MOUSE, Vector2, Vector3, Vector4, Quaternion, Matrix4, Spherical, Box3, Sphere, Raycaster } });

/** The camera counts as moving for this long after its last move. */
const MOVING_MS = 120;
/** Without a move for this long, traced pictures are wanted again: shorter than `MOVING_MS`, so that the first one is there as the camera counts as still. */
const HELD_MS = 60;
const PIXEL_BUDGET = { low: 200_000, medium: 500_000, full: MAX_PIXELS };
/** Of a picture that is worth tracing [pixels]. */
const LEAST_SIDE = 16;

export class Viewport {
  private readonly camera = new PerspectiveCamera(40, 1, 0.01, 100);
  private readonly controls: CameraControls;
  private readonly box = new Box3();
  /** Of the box. */
  private readonly bounds = new Sphere(new Vector3(), 1);
  /** From the object to where the first picture is taken from. */
  private homeDirection: Vector3 | null = null;
  /** How far down the middle of what no panel covers was when the object was last moved there [CSS pixels]. */
  private freeMiddle = 0;
  /** The asset that was framed when it was opened. */
  private framedAsset = '';
  private readonly fly: FlyControls;
  private readonly lookThrough: LookThrough;
  private readonly traced: TracedPicture;
  private readonly local: LocalLayer;
  private readonly gizmo: Gizmo;
  /** Of the camera and settings on screen; -1: to be asked for. */
  private cameraNumber = 0;
  private fresh = false;
  private readonly loop: FrameLoop;
  private lastTick = performance.now();
  private movedAt = -Infinity;

  constructor(
    private readonly stage: HTMLElement,
    tracedCanvas: HTMLCanvasElement,
    localCanvas: HTMLCanvasElement,
  ) {
    const reducedMotion = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.camera.up.set(0, 0, 1);
    this.controls = new CameraControls(this.camera, stage);
    this.controls.mouseButtons.right = CameraControls.ACTION.TRUCK;
    this.controls.touches.two = CameraControls.ACTION.TOUCH_DOLLY_TRUCK;
    this.controls.smoothTime = reducedMotion ? 0 : 0.12;
    this.controls.draggingSmoothTime = reducedMotion ? 0 : 0.04;
    this.loop = new FrameLoop(this.tick);
    this.traced = new TracedPicture(stage, tracedCanvas);
    this.local = new LocalLayer(stage, localCanvas, this.camera, this.bounds, reducedMotion, () => this.updateLayers(), () => this.loop.wake());
    this.gizmo = new Gizmo(stage);
    this.fly = new FlyControls(this.camera, this.controls, this.bounds);
    this.lookThrough = new LookThrough(stage, this.camera, this.controls, this.bounds, reducedMotion ? 0 : undefined);
    listen(this.onHello, this.onFrame);
    listenToPointers(stage, this.controls, new PointerTools(stage, this.camera, this.controls, this.gizmo, this.local.picture));
    new ResizeObserver(this.onResize).observe(stage);
    this.followCamera();
    this.followPicture();
    this.local.followState();
  }

  // ---- what the page asks for --------------------------------------------------------------------------------------------

  /** Show the whole object in the part of the window that no panel covers, from where the camera is. */
  frame(): void {
    this.leaveView();
    flying.value = false;
    this.showAll(this.camera.position.clone().sub(this.controls.getTarget(new Vector3())), true);
  }

  reset(): void {
    this.leaveView();
    flying.value = false;
    if (this.homeDirection) this.showAll(this.homeDirection, true);
  }

  /** Move the object to the middle of what is free now, as large as it is: on a phone panels take half of the picture, and give it back. */
  keepClear(): void {
    const { clientWidth: width, clientHeight: height } = this.stage;
    if (viewNumber.value !== null || !height) return; // a view of the capture keeps clear by itself
    const { y } = freeArea(width, height);
    const perPixel = (2 * this.controls.distance * Math.tan((this.camera.fov * Math.PI) / 360)) / height;
    const offset = this.controls.getFocalOffset(new Vector3());
    void this.controls.setFocalOffset(offset.x, offset.y - (y - this.freeMiddle) * perPixel, offset.z, true);
    this.freeMiddle = y;
  }

  /** The traced picture as PNG; null while there is none. */
  still(): Promise<Blob | null> {
    return this.traced.still();
  }

  // ---- the camera --------------------------------------------------------------------------------------------------------

  /** Look at the object from `direction`, so near that it fills the free part of the window. */
  private showAll(direction: Vector3, smooth: boolean): void {
    const { clientWidth: width, clientHeight: height } = this.stage;
    const { eye, center, focalOffset } = frameBox(this.box, direction, this.camera, { width, height });
    void this.controls.setLookAt(eye.x, eye.y, eye.z, center.x, center.y, center.z, smooth);
    void this.controls.setFocalOffset(focalOffset.x, focalOffset.y, 0, smooth);
    this.freeMiddle = freeArea(width, height).y;
  }

  /** The camera is the controls' again, where it was before it looked through a view of the capture. */
  private leaveView(): void {
    viewNumber.value = null;
    this.lookThrough.apply(performance.now());
  }

  /** Camera and size of the picture now, as REST and stream take them. */
  private get view(): View {
    const width = this.stage.clientWidth * screenPixelRatio();
    const height = this.stage.clientHeight * screenPixelRatio();
    const scale = Math.min(1, Math.sqrt(PIXEL_BUDGET[resolution.value] / Math.max(1, width * height)), MAX_SIDE / Math.max(width, height, 1));
    return viewOf(this.camera, { width: Math.floor(width * scale), height: Math.floor(height * scale) });
  }

  /** Tell the server and the page where the camera is. */
  private sendView(): void {
    const { view } = this;
    if (view.width < LEAST_SIDE || view.height < LEAST_SIDE) return;
    const number = sendCamera(view);
    if (number === null || number === this.cameraNumber) return;
    this.cameraNumber = number;
    if (this.framedAsset === openedAsset.value) {
      viewNow.value = view;
      aimNow.value =
        viewNumber.value === null
          ? { eye: this.controls.getPosition(new Vector3()).toArray(), target: this.controls.getTarget(new Vector3()).toArray(), fov_y_degrees: this.camera.fov }
          : aimOf(view, this.bounds.center.toArray());
    }
    this.updateFresh(); // its picture may be here already
  }

  private followCamera(): void {
    effect(() => {
      this.stage.dataset.flying = String(flying.value);
      if (flying.value) untracked(() => this.leaveView());
      this.fly.setActive(flying.value);
    });
    effect(() => {
      this.loop.wake();
      this.stage.dataset.view = String(viewNumber.value ?? '');
      if (viewNumber.value !== null) flying.value = false;
    });
    effect(() => {
      const wanted = wantedAim.value;
      if (!wanted) return;
      this.loop.wake();
      untracked(() => this.leaveView());
      this.camera.fov = wanted.fov_y_degrees;
      this.camera.updateProjectionMatrix();
      void this.controls.setLookAt(...wanted.eye, ...wanted.target, wanted.smooth);
    });
    effect(() => {
      this.stage.dataset.tool = shapeTool.value === 'none' ? tool.value : shapeTool.value;
    });
  }

  private onResize = () => {
    this.loop.wake();
    const { clientWidth: width, clientHeight: height } = this.stage;
    if (!width || !height) return;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.local.resize();
    this.freeMiddle = freeArea(width, height).y;
  };

  // ---- from the server ---------------------------------------------------------------------------------------------------

  private onHello = (hello: ServerHello) => {
    this.loop.wake();
    this.box.set(new Vector3(...hello.minimum), new Vector3(...hello.maximum));
    this.box.getBoundingSphere(this.bounds);
    this.controls.minDistance = 0.05 * this.bounds.radius;
    this.controls.maxDistance = 60 * this.bounds.radius;
    this.traced.forget();
    if (this.framedAsset === hello.asset) return; // a reconnection keeps the view
    this.framedAsset = hello.asset;
    this.stage.removeAttribute('data-picture');
    const m = hello.start_view.world_from_camera;
    this.homeDirection = new Vector3(m[0][2], m[1][2], m[2][2]);
    this.camera.fov = hello.start_view.fov_y_degrees;
    this.camera.updateProjectionMatrix();
    this.showAll(this.homeDirection, false);
    this.controls.update(0);
    this.updateLayers();
  };

  private onFrame = (header: FrameHeader, picture: ImageBitmap, cameraNumber: number) => {
    this.traced.show(header, picture, cameraNumber);
    this.setFresh(this.traced.isOf(this.cameraNumber) && (this.traced.hasEnoughSamples || this.fresh));
  };

  // ---- which picture shows -----------------------------------------------------------------------------------------------

  private updateFresh(): void {
    this.setFresh(this.traced.isOf(this.cameraNumber) && this.traced.hasEnoughSamples);
  }

  private setFresh(fresh: boolean): void {
    this.fresh = fresh;
    this.stage.dataset.fresh = String(fresh);
    this.updateLayers();
  }

  private updateLayers(): void {
    // The mesh may come before the server has said where to look at it from: until then it would be seen from a place of no meaning.
    if (this.framedAsset !== openedAsset.value) return;
    const picture = !this.local.standsIn ? 'traced' : this.fresh ? 'fresh' : 'stale';
    if (this.stage.dataset.picture === picture || !(this.traced.exists || picture === 'stale')) return;
    this.stage.dataset.picture = picture;
    if (picture === 'stale') this.local.redraw();
  }

  private followPicture(): void {
    let last: unknown[] = [];
    effect(() => {
      const { exposure_stops, tone_curve, background, channel, denoise, turn_light } = settings.value;
      const now = [edits.value, exposure_stops, tone_curve, background, channel, denoise, turn_light];
      if (now.every((value, i) => value === last[i])) return;
      // Settings renumber the camera; the next animation frame asks by which number.
      if (now.slice(1).some((value, i) => value !== last[i + 1])) this.cameraNumber = -1;
      last = now;
      this.loop.wake();
      // A picture may come before the news that it shows the newest edits; a slider put back where it was asks for no new one.
      this.updateFresh();
    });
    effect(() => {
      if (openedAsset.value !== this.framedAsset) this.stage.removeAttribute('data-picture');
      session.value;
      this.loop.wake();
      this.cameraNumber = -1; // a new stream counts anew
      untracked(() => this.setFresh(false));
    });
    effect(() => {
      localPicture.value;
      this.updateLayers();
    });
    effect(() => {
      this.stage.dataset.before = String(before.value);
    });
    effect(() => {
      const { splitAt } = this.local;
      this.stage.dataset.split = String(splitAt !== null);
      this.stage.style.setProperty('--split', `${100 * (splitAt ?? 0)}%`);
    });
    effect(() => {
      const { background } = settings.value;
      this.stage.dataset.background = Array.isArray(background) ? 'colour' : background;
      this.stage.style.setProperty('--background-colour', Array.isArray(background) ? `rgb(${background.map((c) => Math.round(255 * c)).join(' ')})` : 'transparent');
    });
  }

  // ---- every animation frame ---------------------------------------------------------------------------------------------

  private readonly tick = (now: number, elapsed: number) => {
    const { lastTick } = this;
    this.lastTick = now;
    this.fly.update(elapsed / 1000);
    const moved = this.lookThrough.apply(now) ?? this.controls.update(elapsed / 1000);
    if (moved) this.loop.wake();
    // In motion since the last picture, however long that took.
    if (moved && this.movedAt === lastTick) this.local.measure(elapsed);
    if (!session.value) return;
    if (moved) {
      this.movedAt = now;
      this.local.redraw();
    }
    this.sendView();
    const moving = now - this.movedAt < MOVING_MS;
    // A picture that is old when it comes shows nowhere while the local one stands in: the server's cores are the browser's, or another user's.
    holdFrames(this.local.standsIn && now - this.movedAt < HELD_MS);
    this.local.draw(now, { resting: now - this.movedAt > MOVING_MS, covered: this.fresh });
    this.drawGizmo();
    this.stage.dataset.moving = String(moving);
  };

  private drawGizmo(): void {
    const { radius, center } = this.bounds;
    const distance = this.camera.position.distanceTo(center);
    // Handles may be taken far from the object.
    this.gizmo.draw(this.camera, 0.002 * radius, distance + 1000 * radius, this.stage.clientWidth, this.stage.clientHeight, screenPixelRatio());
  }
}

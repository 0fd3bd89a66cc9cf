/**
 * The window on the object: camera control, the traced picture, and the local picture under it.
 *
 * The traced picture is `fresh` when it shows the newest camera and the newest edits. With the local picture on, a stale traced
 * picture is hidden and a fresh one fades in; without it the newest traced picture always stays.
 */

import { effect, untracked } from '@preact/signals';
import CameraControls from 'camera-controls';
import { Box3, Matrix4, MOUSE, PerspectiveCamera, Quaternion, Raycaster, Sphere, Spherical, Vector2, Vector3, Vector4 } from 'three';
import * as api from './api';
import { wireframe } from './channels';
import { Flight } from './flight';
import { frameBox } from './framing';
import { Gizmo } from './gizmo';
import { LocalPace } from './local_pace';
import { LocalPicture } from './local_picture';
import { LookThrough } from './look_through';
import { photographInSight, split, viewNumber } from './photographs';
import { FLAG_CONVERGED, FLAG_MOVING, MAX_PIXELS, MAX_SIDE, type FrameHeader, type ServerHello } from './protocol.gen';
import { listen, sendCamera } from './session';
import { pinWeights } from './pins';
import { listenToPointers } from './pointers';
import { shapeTool } from './shaping';
import { Touching } from './touching';
import { aimNow, aimOf, viewNow, viewOf, wantedAim, type View } from './viewpoint';
import { deformPoints, isAnalytic } from './shape';
import { balls, ballsWanted, before, capturedLight, draft, edits, flash, flying, light, localPicture, log, materials, mesh, notify, pending, resolution, selectionWeights, session, settings, tool } from './state';

CameraControls.install({ THREE: { MOUSE, Vector2, Vector3, Vector4, Quaternion, Matrix4, Spherical, Box3, Sphere, Raycaster } });

const BALL_PIXELS = 72;
const SKY_PIXELS = 160;
/** How long a selection shows, in two pulses. */
const FLASH_MS = 1400;
const PINS_STRENGTH = 0.7;
const MOVING_MS = 120;
const PIXEL_BUDGET = { low: 200_000, medium: 500_000, full: MAX_PIXELS };
/** A fresh picture with fewer samples a pixel than this is too noisy to replace the local one: denoised, and as it is. */
const SHOW_FROM_SAMPLES = { denoised: 4, raw: 16 };

export class Viewport {
  private readonly camera = new PerspectiveCamera(40, 1, 0.01, 100);
  private readonly controls: CameraControls;
  private readonly traced: CanvasRenderingContext2D;
  private local: LocalPicture | null = null;
  private readonly box = new Box3();
  private readonly bounds = new Sphere(new Vector3(), 1);
  /** From the object to where the first picture is taken from. */
  private homeDirection: Vector3 | null = null;
  private framedSession = '';
  private lastTick = performance.now();
  private movedAt = -Infinity;
  private cameraNumber = 0;
  private newestFrame = 0;
  private fresh = false;
  /** Of the picture on the traced canvas. */
  private drawn = { revision: -1, camera: -1, enough: false };
  private localDirty = true;
  private readonly localPace = new LocalPace();
  private localSharp = true;
  private localMesh = '';
  private localEnvironment = '';
  private flashedAt = -Infinity;
  private readonly stillMotion = matchMedia('(prefers-reduced-motion: reduce)').matches;
  private readonly flight: Flight;
  private readonly gizmo: Gizmo;
  private readonly lookThrough: LookThrough;

  constructor(
    private readonly stage: HTMLElement,
    private readonly tracedCanvas: HTMLCanvasElement,
    localCanvas: HTMLCanvasElement,
  ) {
    this.traced = tracedCanvas.getContext('2d')!;
    this.camera.up.set(0, 0, 1);
    this.controls = new CameraControls(this.camera, stage);
    this.controls.mouseButtons.right = CameraControls.ACTION.TRUCK;
    this.controls.touches.two = CameraControls.ACTION.TOUCH_DOLLY_TRUCK;
    this.controls.smoothTime = this.stillMotion ? 0 : 0.12;
    this.controls.draggingSmoothTime = this.stillMotion ? 0 : 0.04;
    try {
      this.local = new LocalPicture(localCanvas);
    } catch {
      notify('This browser offers no WebGL 2, so the instant local picture is off; traced pictures work.', 'info');
      localPicture.value = false;
    }
    this.gizmo = new Gizmo(stage);
    this.flight = new Flight(this.camera, this.controls, this.bounds);
    this.lookThrough = new LookThrough(stage, this.camera, this.controls, this.bounds, this.stillMotion ? 0 : undefined);
    listen(this.onHello, this.onFrame);
    listenToPointers(stage, this.controls, new Touching(stage, this.camera, this.controls, this.gizmo, this.local));
    new ResizeObserver(this.onResize).observe(stage);
    this.followState();
    requestAnimationFrame(this.tick);
  }

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

  /** The camera is the controls' again, where it was before it looked through a view of the capture. */
  private leaveView(): void {
    viewNumber.value = null;
    this.lookThrough.apply(performance.now());
  }

  /** The traced picture as PNG; null while there is none. */
  still(): Promise<Blob | null> {
    return this.newestFrame ? new Promise((resolve) => this.tracedCanvas.toBlob(resolve, 'image/png')) : Promise.resolve(null);
  }

  /** Camera and size of the picture now, as REST and stream take them. */
  private get pose(): View {
    return viewOf(this.camera, this.pictureSize());
  }

  // ---- from the server ---------------------------------------------------------------------------------------------------

  private onHello = (hello: ServerHello) => {
    this.box.set(new Vector3(...hello.minimum), new Vector3(...hello.maximum));
    this.box.getBoundingSphere(this.bounds);
    this.controls.minDistance = 0.05 * this.bounds.radius;
    this.controls.maxDistance = 60 * this.bounds.radius;
    this.newestFrame = 0;
    if (this.framedSession === hello.asset) return; // a reconnection keeps the view
    this.framedSession = hello.asset;
    this.stage.removeAttribute('data-picture');
    const m = hello.start_view.world_from_camera;
    this.homeDirection = new Vector3(m[0][2], m[1][2], m[2][2]);
    this.camera.fov = hello.start_view.fov_y_degrees;
    this.camera.updateProjectionMatrix();
    this.showAll(this.homeDirection, false);
    this.controls.update(0);
  };

  /** Look at the object from `direction`, so near that it fills the free part of the window. */
  private showAll(direction: Vector3, smooth: boolean): void {
    const { clientWidth: width, clientHeight: height } = this.stage;
    const { eye, center, focalOffset } = frameBox(this.box, direction, this.camera, { width, height });
    void this.controls.setLookAt(eye.x, eye.y, eye.z, center.x, center.y, center.z, smooth);
    void this.controls.setFocalOffset(focalOffset.x, focalOffset.y, 0, smooth);
  }

  private onFrame = (header: FrameHeader, picture: ImageBitmap, cameraNumber: number) => {
    this.newestFrame = header.frameId;
    // The first answer to a change counts as moving, yet may have all its samples from before; nothing follows then.
    const converged = (header.flags & FLAG_CONVERGED) !== 0;
    const few = Math.min(settings.value.denoise ? SHOW_FROM_SAMPLES.denoised : SHOW_FROM_SAMPLES.raw, header.sppTarget);
    const enough = converged || (header.spp >= few && !(header.flags & FLAG_MOVING));
    if (this.tracedCanvas.width !== header.width || this.tracedCanvas.height !== header.height) {
      this.tracedCanvas.width = header.width;
      this.tracedCanvas.height = header.height;
    } else this.traced.clearRect(0, 0, header.width, header.height);
    this.traced.drawImage(picture, 0, 0, header.width, header.height);
    picture.close();
    this.stage.dataset.tracedFrames = String(Number(this.stage.dataset.tracedFrames ?? 0) + 1);
    this.stage.dataset.samples = String(header.spp);
    this.stage.dataset.revision = String(header.stateRev);
    this.drawn = { revision: header.stateRev, camera: cameraNumber, enough };
    this.setFresh(this.drawnIsNewest && (enough || this.fresh));
  };

  /** Whether the picture on the traced canvas is of the newest camera, settings and edits. */
  private get drawnIsNewest(): boolean {
    const settled = draft.value === null && pending.value.length === 0;
    return settled && this.drawn.camera === this.cameraNumber && this.drawn.revision >= log.value.revision;
  }

  // ---- what is shown -----------------------------------------------------------------------------------------------------

  /** Only the final picture of a shape that the browser can follow has a local stand-in. */
  private get localShows(): boolean {
    return localPicture.value && this.local !== null && this.local.hasMesh && settings.value.channel === 'final' && session.value !== null && isAnalytic(edits.value);
  }

  /** Left of this share of the width the object stands as captured; a photograph that stands there needs no picture of ours. */
  private get splitAt(): number | null {
    return photographInSight.value ? null : split.value;
  }

  /** What is held is marked for as long as its brush is chosen. */
  private get marksPins(): boolean {
    return shapeTool.value === 'pins' && isAnalytic(edits.value);
  }

  private setFresh(fresh: boolean): void {
    this.fresh = fresh;
    this.stage.dataset.fresh = String(fresh);
    this.updateLayers();
  }

  private updateLayers(): void {
    const picture = !this.localShows ? 'traced' : this.fresh ? 'fresh' : 'stale';
    if (this.stage.dataset.picture !== picture && (this.newestFrame > 0 || picture === 'stale')) this.stage.dataset.picture = picture;
    this.localDirty = true;
  }

  private followState(): void {
    let last: unknown[] = [];
    effect(() => {
      const now = [edits.value, settings.value.exposure_stops, settings.value.tone_curve, settings.value.background, settings.value.channel, settings.value.denoise];
      if (now.some((value, i) => value !== last[i])) {
        // Settings renumber the camera; the next animation frame asks by which number.
        if (now.slice(1).some((value, i) => value !== last[i + 1])) this.cameraNumber = -1;
        last = now;
        // A picture may come before the news that it shows the newest edits; a slider put back where it was asks for no new one.
        this.setFresh(this.drawnIsNewest && this.drawn.enough);
      }
    });
    effect(() => {
      localPicture.value;
      this.updateLayers();
    });
    effect(() => {
      const rest = mesh.value;
      const shown = before.value ? rest?.materials : materials.value;
      if (shown) this.local?.setMaterials(shown);
      this.localDirty = true;
    });
    let shape: Float32Array | null = null;
    effect(() => {
      const rest = mesh.value?.positions;
      if (!rest) return;
      const next = before.value ? rest : deformPoints(rest, edits.value);
      if (next === shape) return;
      shape = next;
      this.local?.setShape(next);
      this.localDirty = true;
    });
    effect(() => {
      const marked = this.marksPins ? pinWeights.value : selectionWeights.value;
      if (marked) this.local?.setHighlighted(marked);
      this.localDirty = true;
    });
    effect(() => {
      if (flash.value > 0) this.flashedAt = NaN; // from the next picture on, however late that is
    });
    effect(() => {
      this.stage.dataset.before = String(before.value);
      this.localDirty = true;
    });
    effect(() => {
      this.stage.dataset.flying = String(flying.value);
      if (flying.value) untracked(() => this.leaveView());
      this.flight.turn(flying.value);
    });
    effect(() => {
      wireframe.value;
      this.localDirty = true;
    });
    effect(() => {
      this.stage.dataset.split = String(this.splitAt !== null);
      this.stage.style.setProperty('--split', `${100 * (this.splitAt ?? 0)}%`);
      this.localDirty = true;
    });
    effect(() => {
      this.stage.dataset.view = String(viewNumber.value ?? '');
      if (viewNumber.value !== null) flying.value = false;
    });
    effect(() => {
      if (ballsWanted.value && mesh.value) this.drawBalls();
    });
    effect(() => {
      this.stage.dataset.tool = shapeTool.value === 'none' ? tool.value : shapeTool.value;
    });
    effect(() => {
      const wanted = wantedAim.value;
      if (!wanted) return;
      untracked(() => this.leaveView());
      this.camera.fov = wanted.fov_y_degrees;
      this.camera.updateProjectionMatrix();
      void this.controls.setLookAt(...wanted.eye, ...wanted.target, wanted.smooth);
    });
    effect(() => {
      const { background } = settings.value;
      this.local?.setBackground(background);
      this.stage.dataset.background = Array.isArray(background) ? 'colour' : background;
      this.stage.style.setProperty('--background-colour', Array.isArray(background) ? `rgb(${background.map((c) => Math.round(255 * c)).join(' ')})` : 'transparent');
      this.localDirty = true;
    });
    effect(() => {
      session.value;
      this.cameraNumber = -1; // a new stream counts anew
      this.setFresh(false);
    });
    effect(() => {
      const asset = session.value?.asset;
      if (asset && asset !== this.localMesh) void this.loadMesh(asset);
    });
    effect(() => {
      const asset = session.value?.asset;
      if (asset) void this.loadEnvironment(asset, light.value.file);
    });
  }

  private async loadMesh(asset: string): Promise<void> {
    this.localMesh = asset;
    if (!this.local) return;
    this.local.dropMesh();
    this.updateLayers();
    try {
      const rest = await this.local.loadMesh(api.assetMesh(asset));
      if (session.value?.asset === asset) mesh.value = rest;
      this.updateLayers();
    } catch {
      notify('The mesh for the instant local picture could not be loaded; traced pictures work.', 'info');
    }
  }

  private async loadEnvironment(asset: string, file: string | null): Promise<void> {
    const url = file === null ? api.assetEnvironment(asset) : api.environmentFile(file);
    if (!this.local || url === this.localEnvironment) return;
    this.localEnvironment = url;
    try {
      await this.local.loadEnvironment(url, /\.hdr$/i.test(file ?? ''));
      if (file === null) capturedLight.value = this.local.drawSky(SKY_PIXELS);
      this.drawBalls();
    } catch {
      notify('The light for the instant local picture could not be loaded; traced pictures show the right one.', 'info');
    }
  }

  /** Thumbnails of materials under the present light. */
  private drawBalls(): void {
    if (!this.local) return;
    balls.value = this.local.drawBalls(ballsWanted.value, BALL_PIXELS);
    this.resizeLocal();
  }

  // ---- every animation frame ---------------------------------------------------------------------------------------------

  private tick = (now: number) => {
    requestAnimationFrame(this.tick);
    const elapsed = now - this.lastTick;
    this.lastTick = now;
    this.flight.move(elapsed / 1000);
    const moved = this.lookThrough.apply(now) ?? this.controls.update(elapsed / 1000);
    if (moved && now - this.movedAt < MOVING_MS && this.localPace.measure(elapsed)) this.resizeLocal();
    if (!session.value) return;
    if (moved) {
      this.movedAt = now;
      this.localDirty = true;
    }
    this.sendPose();
    this.drawLocal(now, moved);
    this.drawGizmo();
    this.stage.dataset.moving = String(now - this.movedAt < MOVING_MS);
  };

  private drawLocal(now: number, moved: boolean): void {
    if (!this.local?.hasMesh) return;
    if (Number.isNaN(this.flashedAt)) this.flashedAt = now;
    const since = now - this.flashedAt;
    const flashing = since < FLASH_MS;
    const marks = this.marksPins;
    const strength = marks ? PINS_STRENGTH : !flashing ? 0 : this.stillMotion ? 0.5 : 0.85 * Math.sin((2 * Math.PI * since) / FLASH_MS) ** 2;
    // Over a traced picture only the selection is drawn, on nothing.
    const edges = wireframe.value && isAnalytic(edits.value) && !before.value;
    this.local.showEdges(edges);
    const overlay = ((flashing && isAnalytic(edits.value)) || marks || edges) && !(this.localShows && !this.fresh) && !before.value && this.splitAt === null;
    if (flashing || this.stage.dataset.overlay !== String(overlay)) this.localDirty = true;
    this.stage.dataset.overlay = String(overlay);
    if (!this.localShows && !overlay && !before.value && this.splitAt === null) return;
    const sharp = !moved && now - this.movedAt > MOVING_MS;
    if (sharp !== this.localSharp && (this.localDirty || (sharp && !this.fresh))) {
      this.localSharp = sharp;
      this.resizeLocal();
    }
    if (!this.localDirty) return;
    this.localDirty = false;
    const { radius, center } = this.bounds;
    const distance = this.camera.position.distanceTo(center);
    const { rotation, intensity } = light.value;
    this.local!.render(this.camera, Math.max(0.002 * radius, distance - 1.5 * radius), distance + 1.5 * radius, rotation, intensity, settings.value.exposure_stops, settings.value.tone_curve, strength, overlay, this.splitAt);
    this.stage.dataset.localFrames = String(Number(this.stage.dataset.localFrames ?? 0) + 1);
  }

  private drawGizmo(): void {
    const { radius, center } = this.bounds;
    const distance = this.camera.position.distanceTo(center);
    // Handles may be taken far from the object.
    this.gizmo.draw(this.camera, 0.002 * radius, distance + 1000 * radius, this.stage.clientWidth, this.stage.clientHeight, pixelRatio());
  }

  private resizeLocal(): void {
    const scale = this.localSharp ? 1 : this.localPace.scale;
    this.local?.resize(this.stage.clientWidth, this.stage.clientHeight, scale * pixelRatio());
    this.localDirty = true;
  }

  private sendPose(): void {
    const { pose } = this;
    if (pose.width < 16 || pose.height < 16) return;
    const number = sendCamera(pose);
    if (number === null || number === this.cameraNumber) return;
    this.cameraNumber = number;
    if (this.framedSession === session.value?.asset) {
      viewNow.value = pose;
      aimNow.value =
        viewNumber.value === null
          ? { eye: this.controls.getPosition(new Vector3()).toArray(), target: this.controls.getTarget(new Vector3()).toArray(), fov_y_degrees: this.camera.fov }
          : aimOf(pose, this.bounds.center.toArray());
    }
    this.setFresh(this.drawnIsNewest && this.drawn.enough); // its picture may be here already
  }

  private pictureSize(): { width: number; height: number } {
    const width = this.stage.clientWidth * pixelRatio();
    const height = this.stage.clientHeight * pixelRatio();
    const scale = Math.min(1, Math.sqrt(PIXEL_BUDGET[resolution.value] / Math.max(1, width * height)), MAX_SIDE / Math.max(width, height, 1));
    return { width: Math.floor(width * scale), height: Math.floor(height * scale) };
  }

  private onResize = () => {
    const { clientWidth: width, clientHeight: height } = this.stage;
    if (!width || !height) return;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.resizeLocal();
  };
}

const pixelRatio = () => Math.min(window.devicePixelRatio || 1, 2);

/**
 * The window on the object: camera control, the traced picture, and the local picture under it.
 *
 * The traced picture is `fresh` when it shows the newest camera and the newest edits. With the local picture on, a stale traced
 * picture is hidden and a fresh one fades in; without it the newest traced picture always stays.
 */

import { effect } from '@preact/signals';
import CameraControls from 'camera-controls';
import { Box3, Matrix4, MOUSE, PerspectiveCamera, Quaternion, Raycaster, Sphere, Spherical, Vector2, Vector3, Vector4 } from 'three';
import * as api from './api';
import { LocalPicture } from './local_picture';
import { FLAG_CONVERGED, FLAG_MOVING, MAX_PIXELS, MAX_SIDE, type FrameHeader, type ServerHello } from './protocol.gen';
import { editLight, listen, pick, sendCamera } from './session';
import { captured, edits, light, localPicture, log, material, notify, pending, resolution, session, settings } from './state';

CameraControls.install({ THREE: { MOUSE, Vector2, Vector3, Vector4, Quaternion, Matrix4, Spherical, Box3, Sphere, Raycaster } });

const DEGREES_PER_PIXEL = 0.4;
const MOVING_MS = 120;
/** Room around a framed object: 1 is none. */
const MARGIN = 1.06;
/** Sharpness of the local picture while it moves, as shares of the screen's own; slow machines go down this list. */
const LOCAL_SCALES = [1, 0.75, 0.55, 0.4, 0.3];
const SLOW_FRAME_MS = 40;
const AIMED_FRAME_MS = 25;
const QUICK_FRAME_MS = 17.5;
const FRAMES_BEFORE_STEP = 4;
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
  /** Set by changes that no camera number or revision tells: settings. Frames up to this id may still show the old ones. */
  private staleUpTo = 0;
  private fresh = false;
  private localDirty = true;
  /** Index into LOCAL_SCALES, and the running mean of the time between two moving pictures. */
  private localScale = 0;
  private localSharp = true;
  private frameMs = AIMED_FRAME_MS;
  private framesMeasured = 0;
  private localMesh = '';
  private localEnvironment = '';
  private turning: { pointer: number; x: number; rotation: number } | null = null;

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
    const still = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.controls.smoothTime = still ? 0 : 0.12;
    this.controls.draggingSmoothTime = still ? 0 : 0.04;
    try {
      this.local = new LocalPicture(localCanvas);
    } catch {
      notify('This browser offers no WebGL 2, so the instant local picture is off; traced pictures work.', 'info');
      localPicture.value = false;
    }
    listen(this.onHello, this.onFrame);
    this.listenToPointers();
    new ResizeObserver(this.onResize).observe(stage);
    this.followState();
    requestAnimationFrame(this.tick);
  }

  /** Show the whole object in the part of the window that no panel covers, from where the camera is. */
  frame(): void {
    this.showAll(this.camera.position.clone().sub(this.controls.getTarget(new Vector3())), true);
  }

  reset(): void {
    if (this.homeDirection) this.showAll(this.homeDirection, true);
  }

  /** The traced picture as PNG; null while there is none. */
  still(): Promise<Blob | null> {
    return this.newestFrame ? new Promise((resolve) => this.tracedCanvas.toBlob(resolve, 'image/png')) : Promise.resolve(null);
  }

  // ---- from the server ---------------------------------------------------------------------------------------------------

  private onHello = (hello: ServerHello) => {
    this.box.set(new Vector3(...hello.minimum), new Vector3(...hello.maximum));
    this.box.getBoundingSphere(this.bounds);
    this.controls.minDistance = 0.05 * this.bounds.radius;
    this.controls.maxDistance = 60 * this.bounds.radius;
    this.newestFrame = 0;
    this.staleUpTo = 0;
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

  /** Look at the centre of the object from `direction`, so near that its bounding box fills the free part of the window. */
  private showAll(direction: Vector3, smooth: boolean): void {
    const { clientWidth: width, clientHeight: height } = this.stage;
    const free = freeArea(width, height);
    const tangent = Math.tan((this.camera.fov * Math.PI) / 360); // of half the height
    const center = this.box.getCenter(new Vector3());
    const back = direction.clone().normalize();
    const right = new Vector3().crossVectors(this.camera.up, back).normalize();
    const up = new Vector3().crossVectors(back, right);
    let distance = 0;
    for (let corner = 0; corner < 8; corner++) {
      const { min, max } = this.box;
      const p = new Vector3(corner & 1 ? max.x : min.x, corner & 2 ? max.y : min.y, corner & 4 ? max.z : min.z).sub(center);
      const across = Math.max(Math.abs(p.dot(right)) / free.width, Math.abs(p.dot(up)) / free.height);
      distance = Math.max(distance, p.dot(back) + (MARGIN * across * height) / tangent);
    }
    const eye = back.multiplyScalar(distance).add(center);
    const unitsPerPixel = (2 * tangent * distance) / height;
    void this.controls.setLookAt(eye.x, eye.y, eye.z, center.x, center.y, center.z, smooth);
    void this.controls.setFocalOffset((width / 2 - free.x) * unitsPerPixel, (height / 2 - free.y) * unitsPerPixel, 0, smooth);
  }

  private onFrame = (header: FrameHeader, picture: ImageBitmap, cameraNumber: number) => {
    this.newestFrame = header.frameId;
    const shown =
      cameraNumber === this.cameraNumber &&
      header.stateRev >= log.value.revision &&
      pending.value.length === 0 &&
      (header.frameId > this.staleUpTo || (header.flags & FLAG_CONVERGED) !== 0);
    const enough = header.spp >= Math.min(settings.value.denoise ? SHOW_FROM_SAMPLES.denoised : SHOW_FROM_SAMPLES.raw, header.sppTarget) && !(header.flags & FLAG_MOVING);
    if (this.tracedCanvas.width !== header.width || this.tracedCanvas.height !== header.height) {
      this.tracedCanvas.width = header.width;
      this.tracedCanvas.height = header.height;
    } else this.traced.clearRect(0, 0, header.width, header.height);
    this.traced.drawImage(picture, 0, 0, header.width, header.height);
    picture.close();
    this.stage.dataset.samples = String(header.spp);
    this.stage.dataset.revision = String(header.stateRev);
    this.setFresh(shown && (enough || this.fresh));
  };

  // ---- what is shown -----------------------------------------------------------------------------------------------------

  /** Only the final picture has a local stand-in. */
  private get localShows(): boolean {
    return localPicture.value && this.local !== null && this.local.hasMesh && settings.value.channel === 'final' && session.value !== null;
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
    let before: unknown[] = [];
    effect(() => {
      const now = [edits.value, settings.value.exposure_stops, settings.value.background, settings.value.channel, settings.value.denoise];
      if (now.some((value, i) => value !== before[i])) {
        if (now.slice(1).some((value, i) => value !== before[i + 1])) this.staleUpTo = this.newestFrame + 3;
        before = now;
        this.setFresh(false);
      }
    });
    effect(() => {
      localPicture.value;
      this.updateLayers();
    });
    effect(() => {
      this.local?.setMaterial(material.value);
      this.localDirty = true;
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
    this.local.hasMesh = false;
    this.updateLayers();
    try {
      const mean = await this.local.loadMesh(api.assetMesh(asset));
      if (session.value?.asset === asset) captured.value = mean;
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
      this.localDirty = true;
    } catch {
      notify('The light for the instant local picture could not be loaded; traced pictures show the right one.', 'info');
    }
  }

  // ---- every animation frame ---------------------------------------------------------------------------------------------

  private tick = (now: number) => {
    requestAnimationFrame(this.tick);
    const elapsed = now - this.lastTick;
    this.lastTick = now;
    const moved = this.controls.update(elapsed / 1000);
    if (moved && now - this.movedAt < MOVING_MS) this.paceLocal(elapsed);
    if (!session.value) return;
    if (moved) {
      this.movedAt = now;
      this.localDirty = true;
    }
    this.sendPose();
    this.drawLocal(now, moved);
    this.stage.dataset.moving = String(now - this.movedAt < MOVING_MS);
  };

  private drawLocal(now: number, moved: boolean): void {
    if (!this.localShows) return;
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
    this.local!.render(this.camera, Math.max(0.002 * radius, distance - 1.5 * radius), distance + 1.5 * radius, rotation, intensity, settings.value.exposure_stops);
    this.stage.dataset.localFrames = String(Number(this.stage.dataset.localFrames ?? 0) + 1);
  }

  /** Fewer pixels where moving pictures come too slowly, more where there is room: time goes with the number of pixels. */
  private paceLocal(elapsed: number): void {
    this.frameMs += 0.4 * (Math.min(elapsed, 500) - this.frameMs);
    if (++this.framesMeasured < FRAMES_BEFORE_STEP || (this.frameMs < SLOW_FRAME_MS && this.frameMs > QUICK_FRAME_MS)) return;
    const wanted = LOCAL_SCALES[this.localScale]! * Math.sqrt(AIMED_FRAME_MS / this.frameMs);
    const fitting = LOCAL_SCALES.findIndex((scale) => scale <= wanted * 1.05);
    const next = fitting < 0 ? LOCAL_SCALES.length - 1 : Math.max(fitting, this.localScale - 1);
    this.framesMeasured = 0;
    if (next === this.localScale) return;
    this.localScale = next;
    this.frameMs = AIMED_FRAME_MS; // measure anew before the next step
    this.resizeLocal();
  }

  private resizeLocal(): void {
    const scale = this.localSharp ? 1 : LOCAL_SCALES[this.localScale]!;
    this.local?.resize(this.stage.clientWidth, this.stage.clientHeight, scale * pixelRatio());
    this.localDirty = true;
  }

  private sendPose(): void {
    const { width, height } = this.pictureSize();
    if (width < 16 || height < 16) return;
    const e = this.camera.matrixWorld.elements; // columns
    const row = (i: number): [number, number, number, number] => [e[i]!, e[4 + i]!, e[8 + i]!, e[12 + i]!];
    const number = sendCamera({ world_from_camera: [row(0), row(1), row(2), [0, 0, 0, 1]], fov_y_degrees: this.camera.fov, width, height });
    if (number === null || number === this.cameraNumber) return;
    this.cameraNumber = number;
    this.setFresh(false);
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

  // ---- pointers ----------------------------------------------------------------------------------------------------------

  private listenToPointers(): void {
    const { stage, controls } = this;
    const { ACTION } = CameraControls;
    stage.addEventListener(
      'pointerdown',
      (event) => {
        const turns = (event.button === 0 && event.altKey) || (event.button === 2 && event.shiftKey);
        controls.enabled = !turns;
        controls.mouseButtons.middle = event.shiftKey ? ACTION.TRUCK : event.ctrlKey ? ACTION.DOLLY : ACTION.ROTATE;
        if (!turns) return;
        this.turning = { pointer: event.pointerId, x: event.clientX, rotation: light.value.rotation };
        stage.setPointerCapture(event.pointerId);
        event.preventDefault();
      },
      { capture: true },
    );
    stage.addEventListener('pointermove', (event) => {
      const { turning } = this;
      if (!turning || event.pointerId !== turning.pointer) return;
      const degrees = turning.rotation + (event.clientX - turning.x) * DEGREES_PER_PIXEL;
      editLight({ rotation: Math.round((((degrees % 360) + 360) % 360) * 10) / 10 });
    });
    const release = () => {
      this.turning = null;
      controls.enabled = true;
    };
    stage.addEventListener('pointerup', release);
    stage.addEventListener('pointercancel', release);
    stage.addEventListener('contextmenu', (event) => event.preventDefault());
    stage.addEventListener('dblclick', (event) => {
      const box = stage.getBoundingClientRect();
      void pick((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height)?.then((picked) => {
        if (picked.hit && picked.position) void controls.moveTo(...picked.position, true);
      });
    });
    // Arrow keys orbit and + - zoom while the picture has the focus: the camera works without a mouse too.
    stage.addEventListener('keydown', (event) => {
      const step = Math.PI / 36;
      const moves: Record<string, () => void> = {
        ArrowLeft: () => void controls.rotate(-step, 0, true),
        ArrowRight: () => void controls.rotate(step, 0, true),
        ArrowUp: () => void controls.rotate(0, -step, true),
        ArrowDown: () => void controls.rotate(0, step, true),
        '+': () => void controls.dolly(0.1 * controls.distance, true),
        '-': () => void controls.dolly(-0.1 * controls.distance, true),
      };
      const move = event.target === stage && !event.ctrlKey && !event.metaKey ? moves[event.key] : undefined;
      if (!move) return;
      event.preventDefault();
      move();
    });
  }
}

const pixelRatio = () => Math.min(window.devicePixelRatio || 1, 2);

/** Centre and size of what bars and open panels leave of the window [CSS pixels]. */
function freeArea(width: number, height: number): { x: number; y: number; width: number; height: number } {
  const edge = (selector: string, side: 'left' | 'right' | 'top' | 'bottom') => document.querySelector(selector)?.getBoundingClientRect()[side];
  const narrow = width < 620; // panels lie below the picture then
  const left = narrow ? 0 : (edge('.library', 'right') ?? 0);
  const right = narrow ? width : (edge('.inspector', 'left') ?? width);
  const top = edge('.topbar', 'bottom') ?? 0;
  const bottom = narrow ? (edge('.panel', 'top') ?? height) : (edge('.hud', 'top') ?? height);
  return { x: (left + right) / 2, y: (top + bottom) / 2, width: right - left, height: bottom - top };
}

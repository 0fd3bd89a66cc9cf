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
const PIXEL_BUDGET = { low: 200_000, medium: 500_000, full: MAX_PIXELS };
/** A fresh picture with fewer samples a pixel than this is too noisy to replace the local one. */
const SHOW_FROM_SAMPLES = 4;

export class Viewport {
  private readonly camera = new PerspectiveCamera(40, 1, 0.01, 100);
  private readonly controls: CameraControls;
  private readonly traced: CanvasRenderingContext2D;
  private local: LocalPicture | null = null;
  private bounds = new Sphere(new Vector3(), 1);
  private home: { eye: Vector3; target: Vector3 } | null = null;
  private framedSession = '';
  private lastTick = performance.now();
  private movedAt = -Infinity;
  private sentPose = '';
  private cameraNumber = 0;
  private newestFrame = 0;
  /** Set by changes that no camera number or revision tells: settings. Frames up to this id may still show the old ones. */
  private staleUpTo = 0;
  private fresh = false;
  private localDirty = true;
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

  frame(): void {
    void this.controls.fitToSphere(this.bounds, true);
  }

  reset(): void {
    if (!this.home) return;
    const { eye, target } = this.home;
    void this.controls.setLookAt(eye.x, eye.y, eye.z, target.x, target.y, target.z, true);
    void this.controls.setFocalOffset(0, 0, 0, true);
  }

  /** The traced picture as PNG; null while there is none. */
  still(): Promise<Blob | null> {
    return this.newestFrame ? new Promise((resolve) => this.tracedCanvas.toBlob(resolve, 'image/png')) : Promise.resolve(null);
  }

  // ---- from the server ---------------------------------------------------------------------------------------------------

  private onHello = (hello: ServerHello) => {
    const box = new Box3(new Vector3(...hello.minimum), new Vector3(...hello.maximum));
    box.getBoundingSphere(this.bounds);
    this.controls.minDistance = 0.05 * this.bounds.radius;
    this.controls.maxDistance = 60 * this.bounds.radius;
    this.newestFrame = 0;
    this.staleUpTo = 0;
    this.sentPose = '';
    if (this.framedSession === hello.asset) return; // a reconnection keeps the view
    this.framedSession = hello.asset;
    this.stage.removeAttribute('data-picture');
    const m = hello.start_view.world_from_camera;
    const eye = new Vector3(m[0][3], m[1][3], m[2][3]);
    const forward = new Vector3(-m[0][2], -m[1][2], -m[2][2]);
    const distance = Math.max(this.bounds.center.clone().sub(eye).dot(forward), 0.1 * this.bounds.radius);
    this.home = { eye, target: eye.clone().addScaledVector(forward, distance) };
    this.camera.fov = hello.start_view.fov_y_degrees;
    this.camera.updateProjectionMatrix();
    const { target } = this.home;
    void this.controls.setLookAt(eye.x, eye.y, eye.z, target.x, target.y, target.z, false);
    void this.controls.setFocalOffset(0, 0, 0, false);
    this.controls.update(0);
  };

  private onFrame = (header: FrameHeader, picture: ImageBitmap, cameraNumber: number) => {
    this.newestFrame = header.frameId;
    const shown =
      cameraNumber === this.cameraNumber &&
      header.stateRev >= log.value.revision &&
      pending.value.length === 0 &&
      (header.frameId > this.staleUpTo || (header.flags & FLAG_CONVERGED) !== 0);
    const enough = header.spp >= Math.min(SHOW_FROM_SAMPLES, header.sppTarget) && !(header.flags & FLAG_MOVING);
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
      const now = [edits.value, settings.value.exposure_stops, settings.value.background, settings.value.channel];
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
      resolution.value;
      this.sentPose = '';
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
    const moved = this.controls.update((now - this.lastTick) / 1000);
    this.lastTick = now;
    if (!session.value) return;
    if (moved) {
      this.movedAt = now;
      this.localDirty = true;
    }
    this.sendPose();
    if (this.localDirty && this.localShows) {
      this.localDirty = false;
      const distance = this.camera.position.distanceTo(this.bounds.center);
      const near = Math.max(0.002 * this.bounds.radius, distance - 4 * this.bounds.radius);
      const turned = light.value;
      this.local!.render(this.camera.matrixWorld, this.camera.fov, this.camera.aspect, near, distance + 4 * this.bounds.radius, turned.rotation, turned.intensity, settings.value.exposure_stops);
      this.stage.dataset.localFrames = String(Number(this.stage.dataset.localFrames ?? 0) + 1);
    }
    this.stage.dataset.moving = String(now - this.movedAt < MOVING_MS);
  };

  private sendPose(): void {
    const { width, height } = this.pictureSize();
    if (width < 16 || height < 16) return;
    const e = this.camera.matrixWorld.elements; // columns
    const row = (i: number): [number, number, number, number] => [e[i]!, e[4 + i]!, e[8 + i]!, e[12 + i]!];
    const pose = `${e.map((value) => value.toPrecision(7)).join()},${width},${height},${this.camera.fov}`;
    if (pose === this.sentPose) return;
    const number = sendCamera({ world_from_camera: [row(0), row(1), row(2), [0, 0, 0, 1]], fov_y_degrees: this.camera.fov, width, height });
    if (number === null) return;
    this.sentPose = pose;
    this.cameraNumber = number;
    this.setFresh(false);
  }

  private pictureSize(): { width: number; height: number } {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = this.stage.clientWidth * ratio;
    const height = this.stage.clientHeight * ratio;
    const scale = Math.min(1, Math.sqrt(PIXEL_BUDGET[resolution.value] / Math.max(1, width * height)), MAX_SIDE / Math.max(width, height, 1));
    return { width: Math.floor(width * scale), height: Math.floor(height * scale) };
  }

  private onResize = () => {
    const { clientWidth: width, clientHeight: height } = this.stage;
    if (!width || !height) return;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.local?.resize(width, height, Math.min(window.devicePixelRatio || 1, 2));
    this.localDirty = true;
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

/** The picture on the page: sized with the window, moved by mouse, fingers and keys, drawn when something has changed. */

import { effect } from '@preact/signals';
import { freeArea } from '../stage/camera/free_area';
import { DynamicResolution } from '../stage/dynamic_resolution';
import { chosenLight, exposureStops, material, panelOpen, rotation, sky, turning, worn } from './choices';
import { between, FOV_DEGREES, moved, same, START, turned, viewOf, zoomed, type Orbit } from './orbit';
import type { PageObject } from './page_object';
import { PagePicture } from './picture';

const DEGREES_PER_PIXEL = 0.35;
const DEGREES_PER_KEY = 7.5;
const ZOOM_PER_KEY = 1.15;
const ZOOM_PER_WHEEL = 0.0012;
/** Of the object that goes round by itself [degrees a second]. */
const TURN_SPEED = 24;
/** In which the camera covers two thirds of the way to where it is wanted [s]. */
const SMOOTHING = 0.07;
/** A picture is still once nothing has moved for so long [ms]. */
const RESTING_MS = 200;
/** A pause between pictures [ms] that belongs to no motion. */
const PAUSE_MS = 1000;
/** Pixels drawn for each CSS pixel, one way. Two are sharp on every screen, and on a coarse one smooth the edges. */
const SHARPNESS = [2, 1.5, 1, 0.75, 0.55];
const FIRST_SHARPNESS = 2;
/** How much sharper a picture at rest may be on a machine that is slow. */
const REST_GAIN = 1.5;
/** Time between pictures [ms] beyond which so many in a row make a machine slow: it draws the coarse mesh in motion from then on. */
const SLOW_MS = 32;
const SLOW_PICTURES = 4;

export class PageStage {
  private readonly picture: PagePicture;
  private wanted: Orbit = START;
  private shown: Orbit = START;
  private dirty = true;
  private sharp = true;
  private movedAt = -Infinity;
  private lastTick = 0;
  private pictures = 0;
  private readonly resolution = new DynamicResolution(SHARPNESS, FIRST_SHARPNESS);
  private slowPictures = 0;
  /** Places of fingers and buttons that are down [CSS pixels]. */
  private readonly pressed = new Map<number, { x: number; y: number }>();

  /** Throws where the picture cannot be drawn. */
  constructor(
    private readonly stage: HTMLElement,
    canvas: HTMLCanvasElement,
    private readonly object: PageObject,
    private readonly reducedMotion: boolean,
  ) {
    this.picture = new PagePicture(canvas, object);
    this.listen();
    effect(() => {
      this.picture.chooseLight(object.lights[chosenLight.value]!);
      this.dirty = true;
    });
    effect(() => {
      this.picture.chooseMaterial(worn.value);
      this.dirty = true;
    });
    effect(() => {
      [rotation.value, exposureStops.value, material.value, sky.value, turning.value, panelOpen.value];
      this.dirty = true;
    });
    new ResizeObserver(() => (this.dirty = true)).observe(stage);
    requestAnimationFrame(this.tick);
  }

  /** As at the beginning, but on the side from which the object is seen now. */
  frame(): void {
    this.go({ ...this.wanted, zoom: START.zoom, shift: START.shift });
  }

  private go(to: Orbit): void {
    this.wanted = to;
    this.dirty = true;
  }

  // ---- hands and keys ------------------------------------------------------------------------------------------------------

  private listen(): void {
    const { stage } = this;
    stage.addEventListener('pointerdown', (event) => {
      stage.setPointerCapture(event.pointerId);
      this.pressed.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    stage.addEventListener('pointermove', (event) => this.drag(event));
    for (const kind of ['pointerup', 'pointercancel', 'lostpointercapture'] as const) stage.addEventListener(kind, (event) => this.pressed.delete(event.pointerId));
    stage.addEventListener('contextmenu', (event) => event.preventDefault());
    stage.addEventListener('dblclick', () => this.frame());
    stage.addEventListener(
      'wheel',
      (event) => {
        event.preventDefault();
        this.go(zoomed(this.wanted, Math.exp(event.deltaY * ZOOM_PER_WHEEL * (event.ctrlKey ? 8 : 1))));
      },
      { passive: false },
    );
    stage.addEventListener('keydown', (event) => {
      const next = this.keyed(event.key);
      if (!next || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      next();
    });
  }

  private drag(event: PointerEvent): void {
    const from = this.pressed.get(event.pointerId);
    if (!from) return;
    const [dx, dy] = [event.clientX - from.x, event.clientY - from.y];
    const height = this.stage.clientHeight;
    const [other] = [...this.pressed].filter(([pointer]) => pointer !== event.pointerId);
    this.pressed.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (other) {
      // Two fingers: what is between them grows and moves along; each finger brings half of the motion.
      const [, { x, y }] = other;
      const before = Math.hypot(from.x - x, from.y - y);
      const after = Math.hypot(event.clientX - x, event.clientY - y);
      this.go(moved(zoomed(this.wanted, before / Math.max(after, 1)), dx / 2 / height, -dy / 2 / height));
    } else if (event.altKey) rotation.value = wrapped(rotation.value + DEGREES_PER_PIXEL * dx);
    else if (event.shiftKey || (event.buttons & 6) !== 0) this.go(moved(this.wanted, dx / height, -dy / height));
    else this.go(turned(this.wanted, DEGREES_PER_PIXEL * dx, DEGREES_PER_PIXEL * dy));
  }

  private keyed(key: string): (() => void) | undefined {
    const step = DEGREES_PER_KEY;
    return {
      ArrowLeft: () => this.go(turned(this.wanted, -step, 0)),
      ArrowRight: () => this.go(turned(this.wanted, step, 0)),
      ArrowUp: () => this.go(turned(this.wanted, 0, step)),
      ArrowDown: () => this.go(turned(this.wanted, 0, -step)),
      '+': () => this.go(zoomed(this.wanted, 1 / ZOOM_PER_KEY)),
      '=': () => this.go(zoomed(this.wanted, 1 / ZOOM_PER_KEY)),
      '-': () => this.go(zoomed(this.wanted, ZOOM_PER_KEY)),
      f: () => this.frame(),
      ' ': () => void (turning.value = !turning.value),
    }[key];
  }

  // ---- every animation frame -------------------------------------------------------------------------------------------------

  private tick = (now: number) => {
    requestAnimationFrame(this.tick);
    const elapsed = now - this.lastTick;
    this.lastTick = now;
    if (turning.value && this.pressed.size === 0) this.wanted = turned(this.wanted, (-TURN_SPEED * Math.min(elapsed, 100)) / 1000, 0);
    const moving = !same(this.shown, this.wanted);
    if (moving) {
      this.shown = between(this.shown, this.wanted, this.reducedMotion ? 1 : 1 - Math.exp(-elapsed / 1000 / SMOOTHING));
      if (now - this.movedAt < PAUSE_MS) this.measure(elapsed);
      this.movedAt = now;
    }
    const resting = now - this.movedAt > RESTING_MS;
    if (!moving && !this.dirty && resting === this.sharp) return;
    this.sharp = resting;
    this.dirty = false;
    this.draw();
  };

  /** On a machine that is too slow for the fine mesh. */
  private get slow(): boolean {
    return this.slowPictures >= SLOW_PICTURES;
  }

  /** The mesh gets coarser before the picture gets blurred. */
  private measure(elapsed: number): void {
    if (this.slow || this.object.meshes.length === 1) this.resolution.measure(elapsed);
    else if (elapsed > SLOW_MS) this.slowPictures++;
    else {
      this.slowPictures = 0;
      this.resolution.measure(elapsed);
    }
  }

  private get sharpness(): number {
    if (!this.sharp) return this.resolution.scale;
    return this.resolution.scale < 1 || this.slow ? Math.min(SHARPNESS[0]!, REST_GAIN * Math.max(this.resolution.scale, 1 / REST_GAIN)) : SHARPNESS[0]!;
  }

  private draw(): void {
    const { stage, object } = this;
    const size = { width: Math.max(1, stage.clientWidth), height: Math.max(1, stage.clientHeight) };
    const { sharpness } = this;
    const detail = this.slow && !this.sharp ? object.meshes.length - 1 : 0;
    this.picture.resize(Math.round(size.width * sharpness), Math.round(size.height * sharpness));
    const free = freeArea(size.width, size.height);
    const view = viewOf(this.shown, object.low, object.high, size, free);
    this.picture.draw({ view, rotation: rotation.value, exposureStops: exposureStops.value, material: material.value, sky: sky.value, detail });
    stage.dataset.pictures = String(++this.pictures);
    stage.dataset.sharpness = String(sharpness);
    stage.dataset.detail = String(detail);
    stage.dataset.camera = JSON.stringify({ eye: view.eye, ...view.axes, focal: size.height / (2 * Math.tan((FOV_DEGREES * Math.PI) / 360)), center: [free.x, free.y] });
  }
}

/** -180..180. */
const wrapped = (degrees: number) => ((((degrees + 180) % 360) + 360) % 360) - 180;

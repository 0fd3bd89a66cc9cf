/**
 * When the local picture is drawn, how sharply, and of what: it follows mesh, edits, light and selection, and is drawn only where it
 * shows, under a stale traced picture or, with nothing but a selection and edges, over a fresh one.
 */

import { effect } from '@preact/signals';
import type { PerspectiveCamera, Sphere } from 'three';
import { photographInSight, split } from '../capture/photographs';
import { capturedEnvironmentThumbnail, light } from '../edit/light';
import { materialThumbnails, namedMaterials } from '../edit/material/presets';
import { flash, selectionWeights } from '../edit/material/selection';
import { materials } from '../edit/material/values';
import { variantMaterials, variantThumbnails } from '../edit/material/variants';
import { mesh } from '../edit/mesh';
import { pinWeights } from '../edit/shape/pins';
import { shapeTool } from '../edit/shape/shape_tools';
import { notify } from '../session/notices';
import { lightCamera, openedAsset, session, settings } from '../session/session';
import { DynamicResolution, screenPixelRatio, SlowMotion } from './dynamic_resolution';
import { LocalPicture } from './local_picture';
import { shapeIsKnown, shapeNow } from './shape_now';
import { before, localPicture, wireframe } from './switches';
import * as api from '../session/api';

const MATERIAL_PIXELS = 72;
const VARIANT_PIXELS = 148;
const SKY_PIXELS = 160;
/** How long a selection shows, in two pulses. */
const FLASH_MS = 1400;
const PINS_STRENGTH = 0.7;

export class LocalLayer {
  /** Null where the browser has no WebGL 2. */
  readonly picture: LocalPicture | null = null;
  private dirty = true;
  private sharp = true;
  private readonly resolution = new DynamicResolution();
  /** Where it is slow, fewer faces are drawn in motion from then on. */
  private readonly motion = new SlowMotion();
  private meshOf = '';
  private environmentUrl = '';
  /** Its light is there, or will not come. */
  private lit = false;
  /** NaN: from the next picture on. */
  private flashedAt = -Infinity;

  /** `onMesh`: there is another mesh to draw, or none; `onChange`: there is another picture to draw, soon. */
  constructor(
    private readonly stage: HTMLElement,
    canvas: HTMLCanvasElement,
    private readonly camera: PerspectiveCamera,
    private readonly bounds: Sphere,
    private readonly reducedMotion: boolean,
    private readonly onMesh: () => void,
    private readonly onChange: () => void,
  ) {
    try {
      this.picture = new LocalPicture(canvas);
    } catch {
      notify('This browser offers no WebGL 2, so the instant local picture is off; traced pictures work.', 'info');
      localPicture.value = false;
    }
  }

  /** Whether it may stand in for the traced picture: only for the final picture, of a shape that the browser knows. */
  get standsIn(): boolean {
    return localPicture.value && this.picture !== null && this.picture.hasMesh && this.lit && settings.value.channel === 'final' && session.value !== null && shapeIsKnown.value;
  }

  /** Left of this share of the width the object stands as captured; a photograph that stands there needs no picture of ours. */
  get splitAt(): number | null {
    return photographInSight.value ? null : split.value;
  }

  /** What a simulation holds is marked for as long as its brush is chosen. */
  private get marksPins(): boolean {
    return shapeTool.value === 'pins' && shapeIsKnown.value;
  }

  redraw(): void {
    this.dirty = true;
    this.onChange();
  }

  resize(): void {
    const scale = this.sharp ? 1 : this.resolution.scale;
    this.picture?.resize(this.stage.clientWidth, this.stage.clientHeight, scale * screenPixelRatio());
    this.redraw();
  }

  /** Take in the time since the last of two pictures in motion, so that motion stays fluent. */
  measure(elapsedMs: number): void {
    // The mesh gets coarser before the picture gets blurred.
    if (this.motion.slow || !this.picture?.canBeCoarse) {
      if (this.resolution.measure(elapsedMs)) this.resize();
    } else this.motion.measure(elapsedMs);
  }

  /** Once each animation frame. `resting`: the camera has been still for a while; `covered`: a fresh traced picture is over it. */
  draw(now: number, { resting, covered }: { resting: boolean; covered: boolean }): void {
    const { picture } = this;
    if (!picture?.hasMesh || !this.lit) return;
    if (Number.isNaN(this.flashedAt)) this.flashedAt = now;
    const since = now - this.flashedAt;
    const flashing = since < FLASH_MS;
    const known = shapeIsKnown.value;
    const marks = this.marksPins;
    const edges = wireframe.value && known && !before.value;
    const shows = this.standsIn && !covered;
    const { splitAt } = this;
    // Over a traced picture only the selection and the edges are drawn, on nothing.
    const overlay = ((flashing && known) || marks || edges) && !shows && !before.value && splitAt === null;
    if (flashing || this.stage.dataset.overlay !== String(overlay)) this.redraw();
    this.stage.dataset.overlay = String(overlay);
    if (!this.standsIn && !overlay && !before.value && splitAt === null) return;
    if (resting !== this.sharp && (this.dirty || (resting && !covered))) {
      this.sharp = resting;
      this.resize();
    }
    if (!this.dirty) return;
    this.dirty = false;
    const pulse = this.reducedMotion ? 0.5 : 0.85 * Math.sin((2 * Math.PI * since) / FLASH_MS) ** 2;
    const { radius, center } = this.bounds;
    const distance = this.camera.position.distanceTo(center);
    picture.render({
      camera: this.camera,
      near: Math.max(0.002 * radius, distance - 1.5 * radius),
      far: distance + 1.5 * radius,
      light: light.value,
      lightCamera: settings.value.turn_light && light.value.file === null ? lightCamera.value : null,
      settings: settings.value,
      highlight: marks ? PINS_STRENGTH : flashing ? pulse : 0,
      onlyHighlight: overlay,
      edges,
      splitAt,
      coarse: !this.sharp && this.motion.slow && picture.canBeCoarse,
    });
    this.stage.dataset.coarse = String(!this.sharp && this.motion.slow && picture.canBeCoarse);
    this.stage.dataset.localFrames = String(Number(this.stage.dataset.localFrames ?? 0) + 1);
  }

  /** From now on. */
  followState(): void {
    effect(() => {
      const rest = mesh.value;
      const shown = before.value ? rest?.materials : materials.value;
      if (shown) this.picture?.setMaterials(shown);
      this.redraw();
    });
    let shape: Float32Array | null = null;
    effect(() => {
      const rest = mesh.value?.positions;
      const next = before.value ? rest : shapeNow.value;
      if (!rest || !next || next === shape) return;
      shape = next;
      this.picture?.setShape(next);
      this.redraw();
    });
    effect(() => {
      const marked = this.marksPins ? pinWeights.value : selectionWeights.value;
      if (marked) this.picture?.setHighlighted(marked);
      this.redraw();
    });
    effect(() => {
      if (flash.value > 0) this.flashedAt = NaN; // however late that picture is
      this.onChange();
    });
    effect(() => {
      wireframe.value;
      settings.value;
      this.splitAt;
      this.redraw();
    });
    effect(() => {
      if (namedMaterials.value && mesh.value) this.drawMaterials();
    });
    effect(() => {
      if (variantMaterials.value) this.drawVariants();
    });
    effect(() => {
      const asset = openedAsset.value;
      if (asset !== null) void this.loadMesh(asset);
    });
    effect(() => {
      const asset = openedAsset.value;
      if (asset !== null) void this.loadEnvironment(asset, light.value.file);
    });
  }

  private async loadMesh(asset: string): Promise<void> {
    if (!this.picture || asset === this.meshOf) return;
    this.meshOf = asset;
    this.picture.dropMesh();
    this.onMesh();
    try {
      const rest = await this.picture.loadMesh(api.assetMesh(asset));
      if (openedAsset.value === asset) mesh.value = rest;
      this.onMesh();
    } catch {
      notify('The mesh for the instant local picture could not be loaded; traced pictures work.', 'info');
    }
  }

  private async loadEnvironment(asset: string, file: string | null): Promise<void> {
    const url = file === null ? api.assetEnvironment(asset) : api.environmentFile(file);
    if (!this.picture || url === this.environmentUrl) return;
    this.environmentUrl = url;
    try {
      await this.picture.loadEnvironment(url, /\.hdr$/i.test(file ?? ''));
      if (file === null) capturedEnvironmentThumbnail.value = this.picture.drawEnvironment(SKY_PIXELS);
    } catch {
      notify('The light for the instant local picture could not be loaded; traced pictures show the right one.', 'info');
    }
    this.lit = true;
    this.redraw();
    this.drawMaterials();
    this.drawVariants();
  }

  /** Thumbnails of materials under the present light. */
  private drawMaterials(): void {
    if (!this.picture || !this.lit) return;
    materialThumbnails.value = this.picture.drawMaterials(namedMaterials.value, MATERIAL_PIXELS);
    this.resize();
  }

  /** Thumbnails of the object in its variants, under the same. */
  private drawVariants(): void {
    const worn = variantMaterials.value;
    if (worn.length === 0) variantThumbnails.value = [];
    else if (this.picture && this.lit) {
      variantThumbnails.value = this.picture.drawVariants(worn, VARIANT_PIXELS);
      this.resize();
    }
  }
}

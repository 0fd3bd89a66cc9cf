/** The server's newest picture on its canvas, and whether it still shows what is wanted. */

import { draft, log, pending } from '../session/edit_log';
import { FLAG_CONVERGED, FLAG_MOVING, type FrameHeader } from '../session/protocol.gen';
import { settings } from '../session/session';

/** With fewer samples a pixel than this a picture is too noisy to replace the local one: denoised, and as it is. */
const SHOW_FROM_SAMPLES = { denoised: 4, raw: 16 };

export class TracedPicture {
  private readonly context: CanvasRenderingContext2D;
  /** Of the picture on the canvas; -1: it is of no camera that counts any more. */
  private shown = { revision: -1, camera: -1, hasEnoughSamples: false };
  private isEmpty = true;

  /** `stage` is told, in data attributes, what is on the canvas. */
  constructor(
    private readonly stage: HTMLElement,
    private readonly canvas: HTMLCanvasElement,
  ) {
    this.context = canvas.getContext('2d')!;
  }

  /** True once there is a picture of the open asset. */
  get exists(): boolean {
    return !this.isEmpty;
  }

  /** What is on the canvas is of another stream. */
  forget(): void {
    this.isEmpty = true;
  }

  show(header: FrameHeader, picture: ImageBitmap, cameraNumber: number): void {
    this.isEmpty = false;
    // The first answer to a change counts as moving, yet may have all its samples from before; nothing follows then.
    const converged = (header.flags & FLAG_CONVERGED) !== 0;
    const few = Math.min(settings.value.denoise ? SHOW_FROM_SAMPLES.denoised : SHOW_FROM_SAMPLES.raw, header.sppTarget);
    const hasEnoughSamples = converged || (header.spp >= few && !(header.flags & FLAG_MOVING));
    if (this.canvas.width !== header.width || this.canvas.height !== header.height) {
      this.canvas.width = header.width;
      this.canvas.height = header.height;
    } else this.context.clearRect(0, 0, header.width, header.height);
    this.context.drawImage(picture, 0, 0, header.width, header.height);
    picture.close();
    this.shown = { revision: header.stateRev, camera: cameraNumber, hasEnoughSamples };
    const { dataset } = this.stage;
    dataset.tracedFrames = String(Number(dataset.tracedFrames ?? 0) + 1);
    dataset.samples = String(header.spp);
    dataset.revision = String(header.stateRev);
  }

  /** Whether it is of this camera, which counts settings too, and of the newest edits. */
  isOf(cameraNumber: number): boolean {
    const settled = draft.value === null && pending.value.length === 0;
    return settled && this.shown.camera === cameraNumber && this.shown.revision >= log.value.revision;
  }

  /** Good enough to replace the local picture. */
  get hasEnoughSamples(): boolean {
    return this.shown.hasEnoughSamples;
  }

  /** As PNG; null while there is none. */
  still(): Promise<Blob | null> {
    return this.exists ? new Promise((resolve) => this.canvas.toBlob(resolve, 'image/png')) : Promise.resolve(null);
  }
}

/** What goes between the page and the worker that writes compressed splats. */

import type { SplatFormat } from '../../../session/constants.gen';

export interface Order {
  /** Of 3D Gaussians, as the server writes it. */
  ply: ArrayBuffer;
  format: SplatFormat;
}

/** `share`: 0..1 of the part that takes long. The last message has `file` or `trouble`. */
export type Answer = { share: number } | { file: ArrayBuffer } | { trouble: string };

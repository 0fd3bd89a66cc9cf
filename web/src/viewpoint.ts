/** Where the picture is seen from, for whatever else wants the same picture: stills and scripts. Written by the viewport. */

import { signal } from '@preact/signals';

export type Row = [number, number, number, number];

export interface View {
  /** OpenGL camera-to-world, rows. */
  world_from_camera: [Row, Row, Row, Row];
  fov_y_degrees: number;
  width: number;
  height: number;
}

/** Null until there is a picture. */
export const viewNow = signal<View | null>(null);

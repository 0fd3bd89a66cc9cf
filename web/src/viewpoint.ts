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

/** Where a camera with z up stands, and the point straight ahead that it turns round. */
export interface Aim {
  eye: [number, number, number];
  target: [number, number, number];
  fov_y_degrees: number;
}

/** The same without the shift that keeps the object clear of the panels: for pictures of another shape than the window's. Written with viewNow. */
export const aimNow = signal<Aim | null>(null);
/** Where the viewport shall look from next: written by whoever wants it, obeyed by the viewport. */
export const wantedAim = signal<(Aim & { smooth: boolean }) | null>(null);

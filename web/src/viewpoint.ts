/** Where the picture is seen from, for whatever else wants the same picture: stills and scripts. Written by the viewport. */

import { signal } from '@preact/signals';
import type { PerspectiveCamera } from 'three';

export type Row = [number, number, number, number];

export interface View {
  /** OpenGL camera-to-world, rows. */
  world_from_camera: [Row, Row, Row, Row];
  fov_y_degrees: number;
  width: number;
  height: number;
}

/** Of three.js' camera, whose matrices are up to date, for a picture of this size. */
export function viewOf(camera: PerspectiveCamera, size: { width: number; height: number }): View {
  const e = camera.matrixWorld.elements; // columns
  const row = (i: number): Row => [e[i]!, e[4 + i]!, e[8 + i]!, e[12 + i]!];
  return { world_from_camera: [row(0), row(1), row(2), [0, 0, 0, 1]], fov_y_degrees: camera.fov, width: size.width, height: size.height };
}

/** Null until there is a picture. */
export const viewNow = signal<View | null>(null);

/** Where a camera with z up stands, and the point straight ahead that it turns round. */
export interface Aim {
  eye: [number, number, number];
  target: [number, number, number];
  fov_y_degrees: number;
}

/** Of a view: its target is where its axis comes nearest to a point. */
export function aimOf({ world_from_camera: rows, fov_y_degrees }: View, near: [number, number, number]): Aim {
  const eye = rows.slice(0, 3).map((row) => row[3]) as Aim['eye'];
  const forward = rows.slice(0, 3).map((row) => -row[2]);
  const distance = Math.max(1e-6, forward.reduce((sum, value, i) => sum + value * (near[i]! - eye[i]!), 0));
  return { eye, target: eye.map((value, i) => value + distance * forward[i]!) as Aim['target'], fov_y_degrees };
}

/** The same without the shift that keeps the object clear of the panels: for pictures of another shape than the window's. Written with viewNow. */
export const aimNow = signal<Aim | null>(null);
/** Where the viewport shall look from next: written by whoever wants it, obeyed by the viewport. */
export const wantedAim = signal<(Aim & { smooth: boolean }) | null>(null);

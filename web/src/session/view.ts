/** Where the picture is seen from, as REST and the stream take it; and the same as eye and target, for films and pictures of another shape. */

import { signal } from '@preact/signals';
import type { PerspectiveCamera } from 'three';

export type Vec3 = [number, number, number];
/** Of a 4×4 matrix. */
export type Row = [number, number, number, number];

export interface View {
  /** OpenGL camera-to-world, rows. */
  world_from_camera: [Row, Row, Row, Row];
  fov_y_degrees: number;
  width: number;
  height: number;
}

/** Of three.js' camera, whose matrices must be up to date, for a picture of this size. */
export function viewOf(camera: PerspectiveCamera, size: { width: number; height: number }): View {
  const e = camera.matrixWorld.elements; // columns
  const row = (i: number): Row => [e[i]!, e[4 + i]!, e[8 + i]!, e[12 + i]!];
  return { world_from_camera: [row(0), row(1), row(2), [0, 0, 0, 1]], fov_y_degrees: camera.fov, width: size.width, height: size.height };
}

/** Of the picture on screen; null until there is one. Written by the viewport. */
export const viewNow = signal<View | null>(null);

/** Where a camera with z up stands, and the point straight ahead that it turns round. */
export interface Aim {
  eye: Vec3;
  target: Vec3;
  fov_y_degrees: number;
}

/** The aim of a view: its target is the point of its axis that is nearest to `near`. */
export function aimOf({ world_from_camera: rows, fov_y_degrees }: View, near: Vec3): Aim {
  const eye = rows.slice(0, 3).map((row) => row[3]) as Vec3;
  const forward = rows.slice(0, 3).map((row) => -row[2]);
  const distance = Math.max(1e-6, forward.reduce((sum, value, i) => sum + value * (near[i]! - eye[i]!), 0));
  return { eye, target: eye.map((value, i) => value + distance * forward[i]!) as Vec3, fov_y_degrees };
}

/** Of the picture on screen, without the shift that keeps the object clear of the panels. Written by the viewport, with viewNow. */
export const aimNow = signal<Aim | null>(null);
/** Where the viewport shall look from next: written by whoever wants it. */
export const wantedAim = signal<(Aim & { smooth: boolean }) | null>(null);

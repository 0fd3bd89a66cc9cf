/** A camera that goes round what it looks at, and the matrices of its picture. World z up; matrices by columns, as graphics cards take them. */

import type { Vec3 } from '../session/view';

export interface Orbit {
  /** Of the eye as seen from the target, counter-clockwise from +x, seen from above [degrees]. */
  azimuth: number;
  /** Above the target's level [degrees]. */
  elevation: number;
  /** Distance as a share of that at which the object fills the picture. */
  zoom: number;
  /** From the object's centre, in its radii. */
  shift: Vec3;
}

/** From the front right and a little above: that of drgs_worker.jobs.start_view. */
export const START: Orbit = { azimuth: -53.7, elevation: 25.8, zoom: 1, shift: [0, 0, 0] };
export const FOV_DEGREES = 40;
/** Objects rarely fill their box: distance as a share of that at which its sphere fills the picture. */
const FILL = 0.92;
const STEEPEST = 89;
const ZOOMS = [0.2, 4] as const;
const FARTHEST_SHIFT = 1.5;

const clamp = (value: number, low: number, high: number) => Math.min(high, Math.max(low, value));

export const turned = (orbit: Orbit, right: number, up: number): Orbit => ({ ...orbit, azimuth: orbit.azimuth - right, elevation: clamp(orbit.elevation + up, -STEEPEST, STEEPEST) });

export const zoomed = (orbit: Orbit, factor: number): Orbit => ({ ...orbit, zoom: clamp(orbit.zoom * factor, ...ZOOMS) });

/** The object follows a hand that moves by shares of the picture's height, up and to the right. */
export function moved(orbit: Orbit, right: number, up: number): Orbit {
  const axes = axesOf(orbit);
  const reach = 2 * FILL * orbit.zoom * Math.tan((FOV_DEGREES * Math.PI) / 360) / Math.sin((FOV_DEGREES * Math.PI) / 360);
  return { ...orbit, shift: orbit.shift.map((old, k) => clamp(old - reach * (right * axes.right[k]! + up * axes.up[k]!), -FARTHEST_SHIFT, FARTHEST_SHIFT)) as Vec3 };
}

/** Part of the way from one place to another, for smooth motion; `share` 1 arrives. */
export function between(from: Orbit, to: Orbit, share: number): Orbit {
  const mix = (a: number, b: number) => a + share * (b - a);
  return { azimuth: mix(from.azimuth, to.azimuth), elevation: mix(from.elevation, to.elevation), zoom: mix(from.zoom, to.zoom), shift: from.shift.map((a, k) => mix(a, to.shift[k]!)) as Vec3 };
}

/** Whether nobody would see the way from one to the other. */
export const same = (a: Orbit, b: Orbit) =>
  Math.abs(a.azimuth - b.azimuth) < 0.02 && Math.abs(a.elevation - b.elevation) < 0.02 && Math.abs(a.zoom - b.zoom) < 2e-4 && a.shift.every((value, k) => Math.abs(value - b.shift[k]!) < 2e-4);

function axesOf({ azimuth, elevation }: Orbit): View['axes'] {
  const [a, e] = [(azimuth * Math.PI) / 180, (elevation * Math.PI) / 180];
  const back: Vec3 = [Math.cos(a) * Math.cos(e), Math.sin(a) * Math.cos(e), Math.sin(e)];
  const right: Vec3 = [-Math.sin(a), Math.cos(a), 0];
  const up: Vec3 = [-Math.cos(a) * Math.sin(e), -Math.sin(a) * Math.sin(e), Math.cos(e)];
  return { right, up, back };
}

export interface View {
  eye: Vec3;
  /** The camera's axes in the world; it looks against `back`. */
  axes: { right: Vec3; up: Vec3; back: Vec3 };
  /** 16 numbers each. */
  clipFromWorld: Float32Array;
  worldFromClip: Float32Array;
}

/** A part of a picture [the picture's pixels], y down. */
export interface Area {
  x: number;
  y: number;
  width: number;
  height: number;
}

/**
 * The view of a box. `free` is the part of the picture that nothing covers, by its centre and size: the target stands in its middle, and the
 * box's sphere fits into it.
 */
export function viewOf(orbit: Orbit, low: Vec3, high: Vec3, picture: { width: number; height: number }, free: Area): View {
  const radius = Math.max(Math.hypot(...low.map((value, k) => high[k]! - value)) / 2, 1e-9);
  const center = low.map((value, k) => (value + high[k]!) / 2 + radius * orbit.shift[k]!) as Vec3;
  const tangent = Math.tan((FOV_DEGREES * Math.PI) / 360);
  const half = Math.atan(tangent * (Math.min(free.width, free.height) / picture.height));
  const distance = ((FILL * radius) / Math.sin(half)) * orbit.zoom;
  const { right, up, back } = axesOf(orbit);
  const eye = center.map((value, k) => value + distance * back[k]!) as Vec3;
  const near = Math.max(0.002 * radius, distance - (1.5 + FARTHEST_SHIFT) * radius);
  const far = distance + (1.5 + FARTHEST_SHIFT) * radius;
  // The middle of the free part, -1..1 from the picture's own, y up.
  const middle = [(2 * free.x) / picture.width - 1, 1 - (2 * free.y) / picture.height] as const;
  const scale = [picture.height / (tangent * picture.width), 1 / tangent] as const;
  const depth = (far + near) / (near - far);
  const depthShift = (2 * far * near) / (near - far);
  const dot = (a: Vec3, b: Vec3) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const clipFromWorld = new Float32Array(16);
  const worldFromClip = new Float32Array(16);
  const rows = [0, 1, 2].map((k) => [scale[0] * right[k]! - middle[0] * back[k]!, scale[1] * up[k]! - middle[1] * back[k]!, depth * back[k]!, -back[k]!]);
  rows.push([-scale[0] * dot(right, eye) + middle[0] * dot(back, eye), -scale[1] * dot(up, eye) + middle[1] * dot(back, eye), -depth * dot(back, eye) + depthShift, dot(back, eye)]);
  clipFromWorld.set(rows.flat());
  // Of a point on the far plane, before division: its w is far, its place in the camera (x far / scale, y far / scale, -far).
  for (let k = 0; k < 3; k++) {
    worldFromClip[k] = right[k]! / scale[0];
    worldFromClip[4 + k] = up[k]! / scale[1];
    worldFromClip[12 + k] = -back[k]! + eye[k]! - (middle[0] * right[k]!) / scale[0] - (middle[1] * up[k]!) / scale[1];
  }
  worldFromClip[15] = 1;
  return { eye, axes: { right, up, back }, clipFromWorld, worldFromClip };
}

/**
 * The way of a film's camera through views, smooth in time: the twin of worker/drgs_worker/jobs/camera_path.py, which says how and why.
 * A view is taken apart into its target, azimuth, elevation and logarithm of the distance around that, and field of view; each is a
 * monotone cubic of time (Fritsch & Butland 1984).
 */

import type { CameraKeyframe } from '../../session/protocol.gen';
import type { Aim, Row, Vec3 } from '../../session/view';

/** Of a keyframe that gives none. */
const SECONDS = 2;
const FOV_Y_DEGREES = 40;
/** Half a turn goes counter-clockwise, even where rounding makes it this much more [turns]. */
const HALF_TURN = 1e-9;

/** On a closed path the first view is the last one, too. */
const passed = (keyframes: CameraKeyframe[], closed: boolean) => (closed && keyframes.length > 1 ? [...keyframes, keyframes[0]!] : keyframes);

/** Of each keyframe, from the first one on [s]. */
function keyframeTimes(keyframes: CameraKeyframe[]): number[] {
  let time = 0;
  return keyframes.map((keyframe, k) => (time += k === 0 ? 0 : (keyframe.seconds ?? SECONDS)));
}

export const pathSeconds = (keyframes: CameraKeyframe[], closed: boolean) => keyframeTimes(passed(keyframes, closed)).at(-1) ?? 0;

/** Pictures of the film, both ends among them; on a closed path the first view is not shown again. */
export function pathFrames(keyframes: CameraKeyframe[], fps: number, closed: boolean): number {
  const steps = pathSeconds(keyframes, closed) * fps;
  return closed ? Math.max(1, Math.ceil(steps - 1e-6)) : Math.floor(steps + 1e-6) + 1;
}

/** Where the camera is at a time; at least one keyframe. */
export function viewAt(keyframes: CameraKeyframe[], time: number, closed: boolean): Aim {
  const all = passed(keyframes, closed);
  const times = keyframeTimes(all);
  const values = all.map(coordinates);
  for (let k = 1; k < values.length; k++) {
    const turn = values[k]![3]! - values[k - 1]![3]!;
    values[k]![3]! -= 2 * Math.PI * Math.floor(turn / (2 * Math.PI) + 0.5 - HALF_TURN); // the shorter way round
  }
  if (values.length < 2) return view(values[0]!);
  const k = Math.max(0, Math.min(times.findLastIndex((other) => other <= time), times.length - 2));
  const step = times[k + 1]! - times[k]!;
  const u = Math.min(1, Math.max(0, (time - times[k]!) / step));
  const rise = u * u * (3 - 2 * u);
  return view(
    values[k]!.map((value, i) => {
      const bends = step * u * (1 - u) * ((1 - u) * slope(times, values, k, i, closed) - u * slope(times, values, k + 1, i, closed));
      return value + rise * (values[k + 1]![i]! - value) + bends;
    }),
  );
}

/** Target, azimuth and elevation of the eye around it, log distance, field of view. */
function coordinates({ eye, target, fov_y_degrees }: CameraKeyframe): number[] {
  const [x, y, z] = eye.map((value, i) => value - target[i]!) as Vec3;
  return [...target, Math.atan2(y, x), Math.atan2(z, Math.hypot(x, y)), Math.log(Math.hypot(x, y, z)), fov_y_degrees ?? FOV_Y_DEGREES];
}

/** Slope of coordinate i at keyframe k, per second: a weighted harmonic mean of the secants on both sides; 0 where they differ in sign, and at open ends. */
function slope(times: number[], values: number[][], k: number, i: number, closed: boolean): number {
  const last = times.length - 1;
  if (!closed && (k === 0 || k === last)) return 0;
  const [from, to] = [k === 0 ? last - 1 : k - 1, k === last ? 0 : k];
  const [stepBefore, stepAfter] = [times[from + 1]! - times[from]!, times[to + 1]! - times[to]!];
  const before = (values[from + 1]![i]! - values[from]![i]!) / stepBefore;
  const after = (values[to + 1]![i]! - values[to]![i]!) / stepAfter;
  if (before * after <= 0) return 0;
  const [weightBefore, weightAfter] = [2 * stepAfter + stepBefore, stepAfter + 2 * stepBefore];
  return (weightBefore + weightAfter) / (weightBefore / before + weightAfter / after);
}

function view([x, y, z, azimuth, elevation, logDistance, fov]: number[]): Aim {
  const distance = Math.exp(logDistance!);
  const backward: Vec3 = [Math.cos(azimuth!) * Math.cos(elevation!), Math.sin(azimuth!) * Math.cos(elevation!), Math.sin(elevation!)];
  const target: Vec3 = [x!, y!, z!];
  return { eye: target.map((value, i) => value + distance * backward[i]!) as Vec3, target, fov_y_degrees: fov! };
}

/** OpenGL camera-to-world, rows, with z up. */
export function worldFromCamera({ eye, target }: Aim): [Row, Row, Row, Row] {
  const offset = eye.map((value, i) => value - target[i]!) as Vec3;
  const distance = Math.hypot(...offset);
  const [bx, by, bz] = offset.map((value) => value / distance) as Vec3;
  const across = Math.hypot(bx, by);
  const [rx, ry] = [-by / across, bx / across];
  const up: Vec3 = [-bz * ry, bz * rx, bx * ry - by * rx];
  return [
    [rx, up[0], bx, eye[0]],
    [ry, up[1], by, eye[1]],
    [0, up[2], bz, eye[2]],
    [0, 0, 0, 1],
  ];
}

/** The film's cameras as the transforms.json that `drgs render --cameras` takes. */
export function asTransforms(keyframes: CameraKeyframe[], fps: number, { width, height }: { width: number; height: number }, closed: boolean): string {
  const frames = Array.from({ length: pathFrames(keyframes, fps, closed) }, (_, k) => {
    const seen = viewAt(keyframes, k / fps, closed);
    const focal = height / 2 / Math.tan((seen.fov_y_degrees * Math.PI) / 360);
    return { file_path: String(k).padStart(4, '0'), fl_x: focal, fl_y: focal, transform_matrix: worldFromCamera(seen) };
  });
  return JSON.stringify({ w: width, h: height, cx: width / 2, cy: height / 2, frames }, null, 1);
}

/** A camera as lines: from its place to the corners of its picture, and round the picture. */

import type { TrainingView } from '../session/protocol.gen';

type Point = [number, number, number];

/** Ends of the lines, three numbers each, two ends a line [world units]; the picture stands `depth` before the camera. */
export function pyramidLines({ world_from_camera: rows, left, right, bottom, top }: TrainingView, depth: number): number[] {
  const place = ([x, y, z]: Point) => rows.slice(0, 3).map((row) => row[0] * x + row[1] * y + row[2] * z + row[3]) as Point;
  const corner = (x: number, y: number) => place([depth * x, depth * y, -depth]); // OpenGL: it looks along -z
  const apex = place([0, 0, 0]);
  const corners = [corner(left, top), corner(right, top), corner(right, bottom), corner(left, bottom)];
  return corners.flatMap((here, k) => [...apex, ...here, ...here, ...corners[(k + 1) % 4]!]);
}

/** What splat-transform asks of its engine (`playcanvas`, 102 MB, for which the build puts this file): the little of its mathematics that a PLY needs, by three.js.
 *
 * A PLY is read and written in one frame, so vectors and rotations only find out that nothing is to be turned. What computes on the GPU is asked for with a
 * device alone, and there is none; its names have to exist. Whatever else a newer version asks for ends the build, or the conversion, with an error. */

import { Euler } from 'three/src/math/Euler.js';
import { MathUtils } from 'three/src/math/MathUtils.js';
import { Quaternion } from 'three/src/math/Quaternion.js';
import { Vector3 } from 'three/src/math/Vector3.js';

export class Vec3 extends Vector3 {
  static readonly RIGHT = new Vec3(1, 0, 0);
  static readonly UP = new Vec3(0, 1, 0);
  static readonly FORWARD = new Vec3(0, 0, -1);

  mulScalar(factor: number): this {
    return this.multiplyScalar(factor);
  }
}

export class Quat extends Quaternion {
  mul2(a: Quat, b: Quat): this {
    return this.multiplyQuaternions(a, b);
  }

  transformVector(vector: Vec3, turned: Vec3): Vec3 {
    return turned.copy(vector).applyQuaternion(this);
  }

  /** In degrees, around the axes that stand still: x, then y, then z. */
  setFromEulerAngles(x: number, y: number, z: number): this {
    return this.setFromEuler(new Euler(MathUtils.degToRad(x), MathUtils.degToRad(y), MathUtils.degToRad(z), 'ZYX'));
  }
}

class Absent {}

export {
  Absent as BindGroupFormat,
  Absent as BindStorageBufferFormat,
  Absent as BindUniformBufferFormat,
  Absent as BoundingBox,
  Absent as Compute,
  Absent as ComputeRadixSort,
  Absent as FloatPacking,
  Absent as Mat3,
  Absent as Mat4,
  Absent as Shader,
  Absent as StorageBuffer,
  Absent as UniformBufferFormat,
  Absent as UniformFormat,
  Absent as Vec2,
};
export const BUFFERUSAGE_COPY_DST = 0;
export const BUFFERUSAGE_COPY_SRC = 0;
export const SHADERLANGUAGE_WGSL = '';
export const SHADERSTAGE_COMPUTE = 0;
export const UNIFORMTYPE_FLOAT = 0;
export const UNIFORMTYPE_UINT = 0;

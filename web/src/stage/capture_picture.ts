/** A small picture in 3D of a capture: the cameras as the pyramids of their pictures, points of the object and its box, on the ground. It can be orbited. */

import CameraControls from 'camera-controls';
import {
  Box3,
  Box3Helper,
  BufferGeometry,
  Color,
  Float32BufferAttribute,
  GridHelper,
  Group,
  LineBasicMaterial,
  LineSegments,
  Matrix4,
  MOUSE,
  PerspectiveCamera,
  Points,
  PointsMaterial,
  Quaternion,
  Raycaster,
  Scene,
  Sphere,
  Spherical,
  Vector2,
  Vector3,
  Vector4,
  WebGLRenderer,
} from 'three';
import type { CaptureLook, TrainingView } from '../session/protocol.gen';
import type { Vec3 } from '../session/view';
import { pyramidLines } from '../capture/pyramid_lines';
import { screenPixelRatio } from './dynamic_resolution';

CameraControls.install({ THREE: { MOUSE, Vector2, Vector3, Vector4, Quaternion, Matrix4, Spherical, Box3, Sphere, Raycaster } });

const FOV_DEGREES = 40;
/** Of the way from a camera to the middle of the object, the length of its pyramid. */
const PYRAMID_SHARE = 0.12;
/** From the middle to the eye: a little from above. */
const FROM = new Vector3(1, -1.4, 0.8);
const POINT_PIXELS = 2;
const GRID_CELLS = 8;

export class CapturePicture {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(FOV_DEGREES, 1);
  private readonly controls: CameraControls;
  private readonly sizes: ResizeObserver;
  private frame = 0;
  private last = performance.now();

  /** Throws where the browser has no WebGL 2. */
  constructor(private readonly canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(screenPixelRatio());
    this.camera.up.set(0, 0, 1);
    this.controls = new CameraControls(this.camera, canvas);
    this.controls.smoothTime = this.controls.draggingSmoothTime = 0;
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(canvas);
  }

  /** Draw a capture that has cameras, `up` of its world on top; colours are those of the page. */
  show(look: CaptureLook, up: Vec3): void {
    if (!look.box_low || !look.box_high) return;
    const style = getComputedStyle(this.canvas);
    const colour = (name: string) => new Color(style.getPropertyValue(name).trim());
    const box = new Box3(new Vector3(...look.box_low), new Vector3(...look.box_high));
    const center = box.getCenter(new Vector3());
    const lines = look.cameras.flatMap((camera) => pyramidLines(camera, PYRAMID_SHARE * placeOf(camera).distanceTo(center)));
    const cameras = new LineSegments(new BufferGeometry().setAttribute('position', new Float32BufferAttribute(lines, 3)), new LineBasicMaterial({ color: colour('--accent') }));
    const points = new Points(
      new BufferGeometry().setAttribute('position', new Float32BufferAttribute(look.points, 3)).setAttribute('color', new Float32BufferAttribute(linear(look.colors), 3)),
      new PointsMaterial({ size: POINT_PIXELS * screenPixelRatio(), sizeAttenuation: false, vertexColors: true }),
    );
    const world = new Group().add(cameras, points, new Box3Helper(box, colour('--good')));
    world.quaternion.setFromUnitVectors(new Vector3(...up).normalize(), this.camera.up);
    const upright = box.clone().applyMatrix4(new Matrix4().makeRotationFromQuaternion(world.quaternion));
    const ground = new GridHelper(2 * box.getSize(new Vector3()).length(), GRID_CELLS, colour('--line'), colour('--line')).rotateX(Math.PI / 2);
    upright.getCenter(ground.position).setZ(upright.min.z);
    this.scene.clear();
    this.scene.add(world, ground);
    const middle = upright.getCenter(new Vector3());
    const radius = Math.max(box.getSize(new Vector3()).length() / 2, ...look.cameras.map((camera) => placeOf(camera).distanceTo(center)));
    const distance = radius / Math.sin((FOV_DEGREES * Math.PI) / 360) / Math.min(1, this.camera.aspect);
    const eye = FROM.clone().setLength(distance).add(middle);
    this.camera.near = distance / 100;
    this.camera.far = 10 * distance;
    this.camera.updateProjectionMatrix();
    void this.controls.setLookAt(eye.x, eye.y, eye.z, middle.x, middle.y, middle.z, false);
    this.canvas.dataset.cameras = String(look.cameras.length);
    cancelAnimationFrame(this.frame);
    this.tick();
  }

  /** The canvas is going away. */
  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.sizes.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
  }

  private readonly tick = (): void => {
    const now = performance.now();
    if (this.controls.update((now - this.last) / 1000) || this.frame === 0) this.renderer.render(this.scene, this.camera);
    this.last = now;
    this.frame = requestAnimationFrame(this.tick);
  };
}

function placeOf({ world_from_camera: rows }: TrainingView): Vector3 {
  return new Vector3(rows[0][3], rows[1][3], rows[2][3]);
}

/** three.js takes colours of vertices as linear. */
function linear(srgb: number[]): number[] {
  const color = new Color();
  return Array.from({ length: srgb.length / 3 }, (_, k) => color.setRGB(srgb[3 * k]!, srgb[3 * k + 1]!, srgb[3 * k + 2]!, 'srgb').toArray()).flat();
}

/** A small picture in 3D of a capture: the cameras as the pyramids of their pictures, points of the object, the build's box and an arrow that points up. It can be
 * orbited. What can be grabbed in it are elements over the canvas (capture_handles.ts), which are told where they stand. */

import CameraControls from 'camera-controls';
import {
  ArrowHelper,
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
import { rotationToUp } from '../capture/build_box';
import { pyramidLines } from '../capture/pyramid_lines';
import type { BoxCorners, CaptureLook, TrainingView } from '../session/protocol.gen';
import type { Vec3 } from '../session/view';
import { screenPixelRatio } from './dynamic_resolution';

CameraControls.install({ THREE: { MOUSE, Vector2, Vector3, Vector4, Quaternion, Matrix4, Spherical, Box3, Sphere, Raycaster } });

const FOV_DEGREES = 40;
/** Of the way from a camera to the middle of the object, the length of its pyramid. */
const PYRAMID_SHARE = 0.12;
/** From the middle to the eye: a little from above. */
const FROM = new Vector3(1, -1.4, 0.8);
const POINT_PIXELS = 2;
const GRID_CELLS = 8;
/** Of the found box's diagonal, from its middle. */
const ARROW_LENGTH = 0.9;
const ARROW_HEAD = 0.08;

export class CapturePicture {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(FOV_DEGREES, 1);
  private readonly controls: CameraControls;
  private readonly sizes: ResizeObserver;
  private readonly world = new Group();
  private readonly about = new Group();
  private framed: CaptureLook | null = null;
  private middle = new Vector3();
  private arrowLength = 1;
  private frame = 0;
  private dirty = true;
  private last = performance.now();

  /**
   * Throws where the browser has no WebGL 2.
   * @param onDrawn the eye or what is drawn has changed.
   */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly onDrawn: () => void,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(screenPixelRatio());
    this.camera.up.set(0, 0, 1);
    this.controls = new CameraControls(this.camera, canvas);
    this.controls.smoothTime = this.controls.draggingSmoothTime = 0;
    this.scene.add(this.world, this.about);
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(canvas);
    this.tick();
  }

  /** Draw a capture that has cameras, `up` of its world on top; `found`: its box in that turned world. Colours are those of the page. */
  show(look: CaptureLook, up: Vec3, found: BoxCorners): void {
    const { colour } = this;
    const center = boxOf({ low: look.box_low!, high: look.box_high! }).getCenter(new Vector3());
    const lines = look.cameras.flatMap((camera) => pyramidLines(camera, PYRAMID_SHARE * placeOf(camera).distanceTo(center)));
    const cameras = new LineSegments(new BufferGeometry().setAttribute('position', new Float32BufferAttribute(lines, 3)), new LineBasicMaterial({ color: colour('--accent') }));
    const points = new Points(
      new BufferGeometry().setAttribute('position', new Float32BufferAttribute(look.points, 3)).setAttribute('color', new Float32BufferAttribute(linear(look.colors), 3)),
      new PointsMaterial({ size: POINT_PIXELS * screenPixelRatio(), sizeAttenuation: false, vertexColors: true }),
    );
    empty(this.world);
    this.world.add(cameras, points);
    const [a, b, c] = rotationToUp(up);
    this.world.quaternion.setFromRotationMatrix(new Matrix4().set(...a, 0, ...b, 0, ...c, 0, 0, 0, 0, 1));
    const upright = boxOf(found);
    const middle = upright.getCenter(new Vector3());
    const size = upright.getSize(new Vector3()).length();
    this.arrowLength = ARROW_LENGTH * size;
    if (this.framed !== look) {
      const radius = Math.max(size / 2, ...look.cameras.map((camera) => placeOf(camera).distanceTo(center)));
      const distance = radius / Math.sin((FOV_DEGREES * Math.PI) / 360) / Math.min(1, this.camera.aspect);
      this.camera.near = distance / 100;
      this.camera.far = 10 * distance;
      this.camera.updateProjectionMatrix();
      this.aim(FROM.clone().setLength(distance).add(middle), middle);
    } else this.aim(this.camera.position.clone().sub(this.middle).add(middle), middle); // as from before, whichever way the world was turned
    this.framed = look;
    this.middle = middle;
    this.canvas.dataset.cameras = String(look.cameras.length);
  }

  /** Draw the build's box, on the ground; and the arrow, `leaning` while it is dragged. */
  showBox(box: BoxCorners, leaning: Vec3): void {
    const { colour } = this;
    const drawn = boxOf(box);
    const ground = new GridHelper(2 * drawn.getSize(new Vector3()).length(), GRID_CELLS, colour('--line'), colour('--line')).rotateX(Math.PI / 2);
    drawn.getCenter(ground.position).setZ(drawn.min.z);
    const head = ARROW_HEAD * this.arrowLength;
    empty(this.about);
    this.about.add(new Box3Helper(drawn, colour('--good')), ground, new ArrowHelper(new Vector3(...leaning).normalize(), this.middle, this.arrowLength, colour('--accent'), head, head));
    this.dirty = true;
  }

  /** Place on the canvas [CSS pixels] of one in the upright world; null behind the eye. */
  onCanvas(place: Vec3): { x: number; y: number } | null {
    this.camera.updateMatrixWorld();
    const seen = new Vector3(...place).project(this.camera);
    if (seen.z > 1) return null;
    return { x: ((1 + seen.x) / 2) * this.canvas.clientWidth, y: ((1 - seen.y) / 2) * this.canvas.clientHeight };
  }

  /** Where the arrow's tip is. */
  tip(leaning: Vec3): Vec3 {
    return new Vector3(...leaning).setLength(this.arrowLength).add(this.middle).toArray();
  }

  /** The direction of the arrow whose tip is seen at a place of the canvas: the nearer one on the ball around the middle, or the nearest on its rim. */
  leaningAt(x: number, y: number): Vec3 {
    const pointer = new Vector2((2 * x) / this.canvas.clientWidth - 1, 1 - (2 * y) / this.canvas.clientHeight);
    const caster = new Raycaster();
    caster.setFromCamera(pointer, this.camera);
    const ball = new Sphere(this.middle, this.arrowLength);
    const met = caster.ray.intersectSphere(ball, new Vector3()) ?? caster.ray.closestPointToPoint(this.middle, new Vector3());
    return met.sub(this.middle).normalize().toArray();
  }

  /** Directions of the upright world that point to the right of the picture and out of it. */
  axes(): { right: Vec3; out: Vec3 } {
    const right = new Vector3();
    const out = new Vector3();
    this.camera.matrixWorld.extractBasis(right, new Vector3(), out);
    return { right: right.toArray(), out: out.toArray() };
  }

  /** The canvas is going away. */
  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.sizes.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
  }

  private readonly colour = (name: string) => new Color(getComputedStyle(this.canvas).getPropertyValue(name).trim());

  private aim(eye: Vector3, middle: Vector3): void {
    void this.controls.setLookAt(eye.x, eye.y, eye.z, middle.x, middle.y, middle.z, false);
    this.dirty = true;
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  private draw(): void {
    this.dirty = false;
    this.renderer.render(this.scene, this.camera);
    this.onDrawn();
  }

  private readonly tick = (): void => {
    const now = performance.now();
    if (this.controls.update((now - this.last) / 1000) || this.dirty) this.draw();
    this.last = now;
    this.frame = requestAnimationFrame(this.tick);
  };
}

function boxOf({ low, high }: BoxCorners): Box3 {
  return new Box3(new Vector3(...low), new Vector3(...high));
}

function placeOf({ world_from_camera: rows }: TrainingView): Vector3 {
  return new Vector3(rows[0][3], rows[1][3], rows[2][3]);
}

/** Take out what a group holds, and free what the graphics card keeps of it. */
function empty(group: Group): void {
  group.traverse((object) => {
    if (!(object instanceof LineSegments || object instanceof Points)) return;
    object.geometry.dispose();
    (object.material as PointsMaterial).dispose();
  });
  group.clear();
}

/** three.js takes colours of vertices as linear. */
function linear(srgb: number[]): number[] {
  const color = new Color();
  return Array.from({ length: srgb.length / 3 }, (_, k) => color.setRGB(srgb[3 * k]!, srgb[3 * k + 1]!, srgb[3 * k + 2]!, 'srgb').toArray()).flat();
}

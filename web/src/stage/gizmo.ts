/**
 * Over the picture: a ball for each handle or corner, and arrows or rings on the chosen one (three.js' TransformControls).
 *
 * It knows no edits: shape_tools.ts says what can be grabbed, and is told where it was moved. Nothing is drawn, and no WebGL context exists,
 * before there is something to grab.
 */

import { effect } from '@preact/signals';
import { BufferAttribute, BufferGeometry, Group, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, Object3D, PerspectiveCamera, Quaternion, Scene, SphereGeometry, Vector3, WebGLRenderer } from 'three';
import { TransformControls } from 'three/addons/controls/TransformControls.js';
import { newKey } from '../edit/gestures';
import { quatXyzwFromTurn, turnFromQuatXyzw } from '../edit/shape/handles';
import { choose, chosen, gizmoMode, grabbables, joined, letGo, moveGrabbed, type Grabbable } from '../edit/shape/shape_tools';
import { notify } from '../session/notices';
import type { Vec3 } from '../session/view';
import { before } from './switches';

/** Radius of a ball [CSS pixels]. */
const BALL = 6;
/** How near a press must be to take one [CSS pixels]. */
const NEAR = { mouse: 9, finger: 22 };
/** Of three.js' own size. */
const ARROWS = 0.75;
const COLOURS = { stays: 0xffffff, moved: 0xf0a63c, chosen: 0x19a6ff, rim: 0x17181a, line: 0xf0a63c };

export class Gizmo {
  private renderer: WebGLRenderer | null = null;
  private readonly canvas = document.createElement('canvas');
  private readonly scene = new Scene();
  private readonly eye = new PerspectiveCamera();
  private readonly transform: TransformControls;
  /** What the arrows move. */
  private readonly held = new Object3D();
  private readonly balls = new Group();
  private readonly lines = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: COLOURS.line, transparent: true, opacity: 0.7, depthTest: false }));
  private readonly sphere = new SphereGeometry(1, 24, 16);
  /** Transparent, so that three.js draws them in this order: lines, rims, faces, arrows. */
  private readonly paints = Object.fromEntries(Object.entries(COLOURS).map(([name, color]) => [name, new MeshBasicMaterial({ color, depthTest: false, transparent: true })])) as Record<keyof typeof COLOURS, MeshBasicMaterial>;
  /** Key of the drag under way. */
  private gesture: string | null = null;
  private dirty = false;
  private refused = false;
  private seenFrom = '';

  constructor(private readonly stage: HTMLElement) {
    this.canvas.className = 'gizmo';
    this.canvas.setAttribute('aria-hidden', 'true');
    this.eye.matrixAutoUpdate = false;
    this.transform = new TransformControls(this.eye);
    this.transform.setSize(ARROWS);
    this.scene.add(this.held, this.lines, this.balls, this.transform.getHelper());
    this.transform.addEventListener('change', () => (this.dirty = true));
    this.transform.addEventListener('objectChange', this.onMoved);
    stage.addEventListener('pointermove', (event) => {
      if (this.gesture || !this.transform.object) return;
      this.transform.pointerHover(this.pointer(event, -1));
      stage.dataset.grabs = String(this.transform.axis !== null);
    });
    effect(() => {
      this.show(grabbables.value, joined.value, chosen.value);
    });
    effect(() => {
      this.transform.setMode(chosen.value?.turn ? gizmoMode.value : 'translate');
      this.dirty = true;
    });
    effect(() => {
      this.canvas.hidden = before.value;
    });
  }

  /** Draw what `camera` sees, if that is not drawn already. */
  draw(camera: PerspectiveCamera, near: number, far: number, width: number, height: number, pixelRatio: number): void {
    const shown = this.balls.children.length > 0;
    if (!shown && !this.dirty) return;
    const seenFrom = [...camera.matrixWorld.elements, camera.fov, width, height, pixelRatio].join();
    if (!this.dirty && seenFrom === this.seenFrom) return;
    const renderer = this.prepared(shown);
    if (!renderer) return;
    if (seenFrom !== this.seenFrom) {
      renderer.setPixelRatio(pixelRatio);
      renderer.setSize(width, height, false);
      Object.assign(this.eye, { fov: camera.fov, aspect: width / height, near, far });
      this.eye.updateProjectionMatrix();
      this.eye.matrix.copy(camera.matrixWorld);
      this.eye.matrixWorldNeedsUpdate = true;
      this.eye.updateMatrixWorld();
    }
    this.seenFrom = seenFrom;
    this.dirty = false;
    const ahead = new Vector3();
    for (const ball of this.balls.children) {
      ahead.copy(ball.position).applyMatrix4(this.eye.matrixWorldInverse);
      ball.scale.setScalar((BALL * 2 * Math.max(near, -ahead.z) * Math.tan((this.eye.fov * Math.PI) / 360)) / height);
    }
    renderer.render(this.scene, this.eye);
    this.stage.dataset.arrows = this.transform.object ? this.pixelsOf(this.held.position).map(Math.round).join() : '';
  }

  /** A press: true where it takes hold of something. */
  grab(event: PointerEvent): boolean {
    if (!this.balls.children.length || !this.renderer) return false;
    const ball = this.ballAt(event);
    if (ball && ball !== chosen.value?.key) choose(ball);
    if (!this.transform.object) return false;
    this.scene.updateMatrixWorld(); // a ball that was chosen this moment can be dragged at once
    this.transform.pointerHover(this.pointer(event, -1));
    this.transform.pointerDown(this.pointer(event, 0));
    if (this.transform.dragging) this.gesture = newKey();
    return this.transform.dragging || ball !== null;
  }

  drag(event: PointerEvent): void {
    if (this.gesture) this.transform.pointerMove(this.pointer(event, -1));
  }

  release(event: PointerEvent): void {
    if (!this.gesture) return;
    this.transform.pointerUp(this.pointer(event, 0));
    this.gesture = null;
    letGo();
  }

  private onMoved = () => {
    const grabbed = chosen.value;
    if (!this.gesture || !grabbed) return;
    const { x, y, z, w } = this.held.quaternion;
    moveGrabbed(grabbed.key, rounded(this.held.position.toArray()), rounded(turnFromQuatXyzw([x, y, z, w])), this.gesture);
  };

  private show(all: Grabbable[], edges: [number, number][], active: Grabbable | null): void {
    this.dirty = true;
    this.balls.clear();
    for (const { key, place, moved } of all) {
      const ball = new Group();
      ball.name = key;
      ball.position.set(...place);
      const rim = new Mesh(this.sphere, this.paints.rim);
      rim.scale.setScalar(1.35);
      const face = new Mesh(this.sphere, this.paints[key === active?.key ? 'chosen' : moved ? 'moved' : 'stays']);
      rim.renderOrder = 1;
      face.renderOrder = 2;
      ball.add(rim, face);
      this.balls.add(ball);
    }
    const ends = Float32Array.from(edges.flat().flatMap((i) => all[i]!.place));
    this.lines.geometry.dispose();
    this.lines.geometry = new BufferGeometry().setAttribute('position', new BufferAttribute(ends, 3));
    this.lines.frustumCulled = false;
    this.stage.dataset.grabbables = String(all.length);
    if (!active) {
      this.transform.detach();
      this.stage.dataset.grabs = 'false';
      return;
    }
    if (this.gesture) return; // during a drag the hand says where it is
    this.held.position.set(...active.place);
    this.held.quaternion.copy(new Quaternion(...quatXyzwFromTurn(active.turn ?? [0, 0, 0])));
    this.transform.attach(this.held);
  }

  /** Key of the ball under the pointer; of several, the one nearest to it. */
  private ballAt(event: PointerEvent): string | null {
    let nearest: number = event.pointerType === 'touch' ? NEAR.finger : NEAR.mouse;
    let found: string | null = null;
    for (const { key, place } of grabbables.value) {
      const [x, y] = this.pixelsOf(new Vector3(...place));
      const distance = Math.hypot(x - event.clientX, y - event.clientY);
      if (distance < nearest) [found, nearest] = [key, distance];
    }
    return found;
  }

  /** Where a place is seen in the window [CSS pixels]; far outside it for what lies behind the eye. */
  private pixelsOf(place: Vector3): [number, number] {
    const box = this.stage.getBoundingClientRect();
    const at = place.clone().project(this.eye);
    return at.z < 1 ? [box.left + ((at.x + 1) / 2) * box.width, box.top + ((1 - at.y) / 2) * box.height] : [-1e6, -1e6];
  }

  /** A pointer as TransformControls takes it: -1..1, y up; button -1 while none changes. */
  private pointer(event: PointerEvent, button: number): PointerEvent {
    const box = this.stage.getBoundingClientRect();
    return { x: (2 * (event.clientX - box.left)) / box.width - 1, y: 1 - (2 * (event.clientY - box.top)) / box.height, button } as unknown as PointerEvent;
  }

  private prepared(needed: boolean): WebGLRenderer | null {
    if (!this.renderer && needed && !this.refused) {
      try {
        this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true, powerPreference: 'low-power' });
        this.stage.append(this.canvas);
      } catch {
        this.refused = true;
        notify('This browser offers no WebGL 2, so handles are not drawn over the picture; their numbers in the panel work.', 'info');
      }
    }
    return this.renderer;
  }
}

/** Six digits: more than a hand can aim. */
const rounded = (values: Vec3) => values.map((value) => Number(value.toPrecision(6))) as Vec3;

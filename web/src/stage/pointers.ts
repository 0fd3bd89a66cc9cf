/** Routes mouse, pen, fingers and arrow keys on the picture: to tools, to the light, or to the camera, which camera-controls moves by itself. */

import CameraControls from 'camera-controls';
import { viewNumber } from '../capture/photographs';
import { newKey } from '../edit/gestures';
import { editLight, light } from '../edit/light';
import { tool } from '../edit/material/selection';
import { shapeTool } from '../edit/shape/shape_tools';
import { flying } from './switches';

const DEGREES_PER_PIXEL = 0.4;
/** A press that moves less and is let go sooner is a click [pixels, ms]. */
const CLICK_PIXELS = 4;
const CLICK_MS = 500;
/** A second tap this soon and this near is a double tap [ms, pixels]. */
const TAP_MS = 300;
const TAP_PIXELS = 24;

export interface PointerActions {
  select(event: PointerEvent): void;
  /** False where the brush met nothing: the drag then is the camera's. */
  paint(event: PointerEvent): boolean;
  /** The brush is lifted. */
  painted(): void;
  /** True where the gizmo took hold of something: the drag then is its own. */
  grab(event: PointerEvent): boolean;
  drag(event: PointerEvent): void;
  release(event: PointerEvent): void;
  focus(event: MouseEvent): void;
}

export function listenToPointers(stage: HTMLElement, controls: CameraControls, on: PointerActions): void {
  const { ACTION } = CameraControls;
  let lightDrag: { pointer: number; x: number; rotation: number; key: string } | null = null;
  let pressed: { pointer: number; x: number; y: number; at: number } | null = null;
  let painting: number | null = null;
  let grabbing: number | null = null;
  const brushes = () => shapeTool.value === 'pins' || (shapeTool.value === 'none' && tool.value === 'brush');
  const clicks = () => shapeTool.value === 'handles' || (shapeTool.value === 'none' && tool.value !== 'all' && tool.value !== 'brush');
  stage.addEventListener(
    'pointerdown',
    (event) => {
      const turns = (event.button === 0 && event.altKey) || (event.button === 2 && event.shiftKey);
      pressed = event.button === 0 && event.isPrimary ? { pointer: event.pointerId, x: event.clientX, y: event.clientY, at: event.timeStamp } : null;
      if (event.button === 0 && event.isPrimary && !turns && on.grab(event)) {
        grabbing = event.pointerId;
        pressed = null;
      } else if (event.button === 0 && brushes() && !turns && on.paint(event)) painting = event.pointerId;
      controls.enabled = !turns && painting === null && grabbing === null;
      if (painting !== null || grabbing !== null) stage.setPointerCapture(event.pointerId);
      controls.mouseButtons.middle = event.shiftKey ? ACTION.TRUCK : event.ctrlKey ? ACTION.DOLLY : ACTION.ROTATE;
      if (!turns) return;
      lightDrag = { pointer: event.pointerId, x: event.clientX, rotation: light.value.rotation, key: newKey() };
      stage.setPointerCapture(event.pointerId);
      event.preventDefault();
    },
    { capture: true },
  );
  stage.addEventListener('pointermove', (event) => {
    if (event.pointerId === painting) on.paint(event);
    if (event.pointerId === grabbing) on.drag(event);
    if (!lightDrag || event.pointerId !== lightDrag.pointer) return;
    const degrees = lightDrag.rotation + (event.clientX - lightDrag.x) * DEGREES_PER_PIXEL;
    editLight({ rotation: Math.round((((degrees % 360) + 360) % 360) * 10) / 10 }, lightDrag.key);
  });
  const release = (event: PointerEvent) => {
    if (event.pointerId === grabbing) on.release(event);
    if (event.pointerId === painting) on.painted();
    lightDrag = painting = grabbing = pressed = null;
    controls.enabled = true;
  };
  stage.addEventListener('pointerup', (event) => {
    const isClick = pressed?.pointer === event.pointerId && Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) < CLICK_PIXELS && event.timeStamp - pressed.at < CLICK_MS;
    if (isClick && !event.altKey && clicks()) on.select(event);
    release(event);
  });
  stage.addEventListener('pointercancel', release);
  stage.addEventListener('contextmenu', (event) => event.preventDefault());
  stage.addEventListener('dblclick', (event) => {
    on.focus(event);
  });
  let tap = { at: -Infinity, x: 0, y: 0 };
  stage.addEventListener('pointerup', (event) => {
    if (event.pointerType !== 'touch' || !event.isPrimary) return;
    const again = event.timeStamp - tap.at < TAP_MS && Math.hypot(event.clientX - tap.x, event.clientY - tap.y) < TAP_PIXELS;
    tap = { at: again ? -Infinity : event.timeStamp, x: event.clientX, y: event.clientY };
    if (again) on.focus(event);
  });
  // Arrow keys orbit and + - zoom while the picture has the focus: the camera works without a mouse too.
  stage.addEventListener('keydown', (event) => {
    const step = Math.PI / 36;
    const moves: Record<string, () => void> = {
      ArrowLeft: () => void controls.rotate(-step, 0, true),
      ArrowRight: () => void controls.rotate(step, 0, true),
      ArrowUp: () => void controls.rotate(0, -step, true),
      ArrowDown: () => void controls.rotate(0, step, true),
      '+': () => void controls.dolly(0.1 * controls.distance, true),
      '-': () => void controls.dolly(-0.1 * controls.distance, true),
    };
    const move = event.target === stage && !flying.value && viewNumber.value === null && !event.ctrlKey && !event.metaKey ? moves[event.key] : undefined;
    if (!move) return;
    event.preventDefault();
    move();
  });
}

import { Box3, PerspectiveCamera, Vector3 } from 'three';
import { afterEach, expect, it, vi } from 'vitest';
import { frameBox } from '../../../src/stage/camera/framing';

afterEach(() => vi.unstubAllGlobals());

type Window = { width: number; height: number };
type Side = 'left' | 'right' | 'top' | 'bottom';

/** Panels by selector, as far as framing asks for them. */
const panels = (found: Record<string, Partial<Record<Side, number>>>) =>
  vi.stubGlobal('document', { querySelector: (selector: string) => (selector in found ? { getBoundingClientRect: () => found[selector] } : null) });

/** Where the corners of the box are on screen [CSS pixels], seen by the camera that framing asks for. */
function cornersOnScreen(box: Box3, direction: Vector3, { width, height }: Window) {
  const camera = new PerspectiveCamera(40, width / height, 0.01, 100);
  camera.up.set(0, 0, 1);
  const { eye, center, focalOffset } = frameBox(box, direction, camera, { width, height });
  camera.position.copy(eye);
  camera.lookAt(center);
  // As camera-controls does: right, and down, in the camera's own axes.
  camera.updateMatrix();
  camera.position.add(new Vector3().setFromMatrixColumn(camera.matrix, 0).multiplyScalar(focalOffset.x));
  camera.position.add(new Vector3().setFromMatrixColumn(camera.matrix, 1).multiplyScalar(-focalOffset.y));
  camera.updateMatrixWorld();
  return Array.from({ length: 8 }, (_, i) => {
    const { min, max } = box;
    const seen = new Vector3(i & 1 ? max.x : min.x, i & 2 ? max.y : min.y, i & 4 ? max.z : min.z).project(camera);
    return { x: ((1 + seen.x) * width) / 2, y: ((1 - seen.y) * height) / 2, depth: seen.z };
  });
}

const BOXES = { cube: new Box3(new Vector3(-0.5, -0.5, 0), new Vector3(0.5, 0.5, 1)), tower: new Box3(new Vector3(2, 2, 0), new Vector3(2.4, 2.3, 3)), plate: new Box3(new Vector3(-2, -1, 0), new Vector3(2, 1, 0.1)) };
const DIRECTIONS = [new Vector3(0.55, -0.75, 0.45), new Vector3(1, 0, 0), new Vector3(-0.2, 0.9, -0.6), new Vector3(0.1, 0.05, 1)];
const DESKTOP = { '.topbar': { bottom: 44 }, '.library': { right: 296 }, '.hud': { top: 680 } };

it.each([
  ['1280x720 with both panels', { width: 1280, height: 720 }, { ...DESKTOP, '.inspector': { left: 984 } }, { left: 296, right: 984, top: 44, bottom: 680 }],
  ['1280x720 with the library alone', { width: 1280, height: 720 }, DESKTOP, { left: 296, right: 1280, top: 44, bottom: 680 }],
  ['an upright tablet', { width: 768, height: 1024 }, { '.topbar': { bottom: 44 }, '.inspector': { left: 472 }, '.hud': { top: 984 } }, { left: 0, right: 472, top: 44, bottom: 984 }],
  ['a phone, whose panels lie below', { width: 390, height: 844 }, { '.topbar': { bottom: 44 }, '.panel': { top: 460 } }, { left: 0, right: 390, top: 44, bottom: 460 }],
  ['a phone with the bar of views over the picture', { width: 390, height: 844 }, { '.topbar': { bottom: 44 }, '.view-bar': { top: 52, bottom: 90 }, '.panel': { top: 460 } }, { left: 0, right: 390, top: 90, bottom: 460 }],
  ['a bare 4K window', { width: 3840, height: 2160 }, {}, { left: 0, right: 3840, top: 0, bottom: 2160 }],
])('the whole object is in the free part of %s, from every side, and fills it', (_, window, covered, free) => {
  panels(covered);
  for (const box of Object.values(BOXES))
    for (const direction of DIRECTIONS) {
      const corners = cornersOnScreen(box, direction, window);
      const [xs, ys] = [corners.map(({ x }) => x), corners.map(({ y }) => y)];
      expect(corners.every(({ depth }) => depth > -1 && depth < 1)).toBe(true);
      expect(Math.min(...xs)).toBeGreaterThan(free.left);
      expect(Math.max(...xs)).toBeLessThan(free.right);
      expect(Math.min(...ys)).toBeGreaterThan(free.top);
      expect(Math.max(...ys)).toBeLessThan(free.bottom);
      const share = Math.max((Math.max(...xs) - Math.min(...xs)) / (free.right - free.left), (Math.max(...ys) - Math.min(...ys)) / (free.bottom - free.top));
      expect(share).toBeCloseTo(1 / 1.06, 3);
    }
});

import { describe, expect, it, vi } from 'vitest';

vi.stubGlobal('matchMedia', () => ({ matches: false }));
const { nearestView, placeView } = await import('../../src/capture/photographs');

const WINDOW = { width: 1200, height: 800 };
const ALL_FREE = { left: 0, right: 1200, top: 0, bottom: 800 };
const SQUARE = { left: -0.5, right: 0.5, top: 0.5, bottom: -0.5 };

describe('placeView', () => {
  it('gives a free window the photograph’s own angle', () => {
    const { fovDegrees, place } = placeView(SQUARE, WINDOW, ALL_FREE);
    expect(fovDegrees).toBeCloseTo((360 / Math.PI) * Math.atan(0.5), 9);
    expect(place).toEqual({ left: 200, top: 0, width: 800, height: 800 });
  });

  it('opens the angle until the photograph fits between the panels', () => {
    const { fovDegrees, place } = placeView(SQUARE, WINDOW, { ...ALL_FREE, right: 900 });
    expect(place).toEqual({ left: 300, top: 100, width: 600, height: 600 });
    // The window is 800 high, 600 of which are the photograph's 1.0 at distance 1.
    expect(Math.tan((fovDegrees * Math.PI) / 360)).toBeCloseTo(400 / 600, 9);
  });

  it('keeps the axis in the middle of the window where it is not in the middle of the photograph', () => {
    const { place } = placeView({ left: -0.2, right: 0.6, top: 0.1, bottom: -0.3 }, WINDOW, ALL_FREE);
    expect((600 - place.left) / place.width).toBeCloseTo(0.25, 9);
    expect((400 - place.top) / place.height).toBeCloseTo(0.25, 9);
    expect(place.left + place.width).toBeCloseTo(1200, 9);
  });

  it('still shows a photograph where panels cover the window’s middle', () => {
    const { place } = placeView(SQUARE, WINDOW, { ...ALL_FREE, right: 400 });
    expect(place.width).toBeCloseTo(180, 9);
  });
});

describe('nearestView', () => {
  it('is the one that looks the same way', () => {
    const view = (x: number, y: number) => ({ name: '', width: 1, height: 1, ...SQUARE, world_from_camera: [[0, 0, x, 9], [0, 0, y, 9], [1, 0, 0, 9], [0, 0, 0, 1]] as [R, R, R, R] });
    type R = [number, number, number, number];
    const views = [view(1, 0), view(0, 1), view(-1, 0)];
    expect(nearestView(views, view(-0.6, 0.8).world_from_camera)).toBe(1);
    expect(nearestView(views, view(-0.8, 0.6).world_from_camera)).toBe(2);
  });
});

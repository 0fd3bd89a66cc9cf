import { afterEach, beforeEach, expect, test, vi } from 'vitest';
import { FrameLoop } from '../../src/stage/frame_loop';

const FRAME_MS = 1000 / 60;
let page: EventTarget;

beforeEach(() => {
  vi.useFakeTimers();
  page = new EventTarget();
  vi.stubGlobal('window', page);
  vi.stubGlobal('requestAnimationFrame', (frame: (now: number) => void) => setTimeout(() => frame(performance.now()), FRAME_MS));
});

afterEach(() => void vi.useRealTimers());

/** Steps that are taken in so many milliseconds: how long the frame before each lasted. */
function stepsIn(ms: number, taken: number[]): number[] {
  taken.length = 0;
  vi.advanceTimersByTime(ms);
  return [...taken];
}

test('a page at rest looks ten times a second and one in use sixty times', () => {
  const taken: number[] = [];
  const loop = new FrameLoop((_, elapsed) => taken.push(elapsed));
  expect(stepsIn(300, taken).length).toBeGreaterThan(14);
  vi.advanceTimersByTime(1000);
  expect(stepsIn(3000, taken).length).toBeLessThan(31);
  loop.wake();
  expect(stepsIn(300, taken).length).toBeGreaterThan(14);
});

test('hands on the page wake it at once, and motion begins as if there had been no rest', () => {
  const taken: number[] = [];
  new FrameLoop((_, elapsed) => taken.push(elapsed));
  for (const kind of ['pointermove', 'wheel', 'keydown', 'input']) {
    vi.advanceTimersByTime(2000);
    page.dispatchEvent(new Event(kind));
    const steps = stepsIn(200, taken);
    expect(steps.length, kind).toBeGreaterThan(8);
    expect(Math.max(...steps), kind).toBeLessThan(2 * FRAME_MS);
  }
});

test('a step that wakes goes on at full pace', () => {
  const taken: number[] = [];
  const loop: FrameLoop = new FrameLoop((_, elapsed) => {
    taken.push(elapsed);
    loop.wake();
  });
  vi.advanceTimersByTime(2000);
  expect(stepsIn(300, taken).length).toBeGreaterThan(14);
});

test('a step that fails is followed by others', () => {
  const taken: number[] = [];
  let failed = false;
  new FrameLoop((_, elapsed) => {
    if (!failed) {
      failed = true;
      throw new Error('no picture');
    }
    taken.push(elapsed);
  });
  expect(() => vi.advanceTimersByTime(FRAME_MS + 1)).toThrow('no picture');
  expect(stepsIn(300, taken).length).toBeGreaterThan(14);
});

import { expect, test } from 'vitest';
import { DynamicResolution, SlowMotion } from '../../src/stage/dynamic_resolution';

/** Milliseconds between pictures of a machine that needs `fullMs` for a sharp one, after it has drawn for a while. */
function settledMs(fullMs: number): number {
  const pace = new DynamicResolution();
  for (let frame = 0; frame < 200; frame++) pace.measure(Math.max(1000 / 60, fullMs * pace.scale ** 2));
  return Math.max(1000 / 60, fullMs * pace.scale ** 2);
}

test('a machine that can draw thirty pictures a second at some sharpness does', () => {
  for (let fullMs = 2; fullMs < 350; fullMs *= 1.07) expect(settledMs(fullMs), `${fullMs} ms a sharp picture`).toBeLessThan(1000 / 30);
});

test('a quick machine draws sharp pictures, and comes back to them after a hitch', () => {
  const pace = new DynamicResolution();
  for (let frame = 0; frame < 10; frame++) pace.measure(400);
  expect(pace.scale).toBeLessThan(1);
  for (let frame = 0; frame < 200; frame++) pace.measure(1000 / 60);
  expect(pace.scale).toBe(1);
});

/** After so many pictures that come in turns after these times [ms]. */
function slowAfter(pictures: number, ...turnsMs: number[]): boolean {
  const motion = new SlowMotion();
  for (let picture = 0; picture < pictures; picture++) motion.measure(turnsMs[picture % turnsMs.length]!);
  return motion.slow;
}

test('a machine is slow where pictures take long, whether each waits or every second one for two', () => {
  expect(slowAfter(5, 200)).toBe(true);
  expect(slowAfter(8, 20, 380)).toBe(true);
  expect(slowAfter(15, 60)).toBe(true);
  expect(slowAfter(1000, 40)).toBe(false);
});

test('hitches make no machine slow, though a first turn has three', () => {
  const motion = new SlowMotion();
  for (const elapsed of [17, 17, 2000, 400, 300, 17, 17, 17, 17, 17, 17, 17, 400, 17]) motion.measure(elapsed);
  expect(motion.slow).toBe(false);
});

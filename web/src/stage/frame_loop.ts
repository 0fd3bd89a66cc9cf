/**
 * Calls a step once each animation frame while something happens, and ten times a second at rest: each frame that a page asks for
 * takes the browser a millisecond of a core, though nothing be drawn.
 */

/** Frames come at full pace for this long after something happened [ms]. */
const AWAKE_MS = 500;
/** Between two looks at rest [ms], for what changes and wakes nobody. */
const REST_MS = 100;
/** The frame behind a rest is as long as any other [ms]: motion begins smoothly. */
const FRAME_MS = 1000 / 60;
/** What people do with the page, wherever on it. */
const HANDS = ['pointerdown', 'pointermove', 'pointerup', 'wheel', 'keydown', 'keyup', 'input', 'resize'];

export class FrameLoop {
  private awakeUntil = performance.now() + AWAKE_MS;
  /** Of the next look; null where a frame is on its way. */
  private timer: ReturnType<typeof setTimeout> | null = null;
  private rested = true;
  private last = performance.now();

  /** `step` is given the time and how long the frame before it lasted [ms]. */
  constructor(private readonly step: (now: number, elapsed: number) => void) {
    for (const kind of HANDS) window.addEventListener(kind, this.wake, { capture: true, passive: true });
    requestAnimationFrame(this.frame);
  }

  /** Something happens. */
  readonly wake = (): void => {
    this.awakeUntil = performance.now() + AWAKE_MS;
    if (this.timer === null) return;
    clearTimeout(this.timer);
    this.ask();
  };

  private readonly ask = (): void => {
    this.timer = null;
    requestAnimationFrame(this.frame);
  };

  private readonly frame = (now: number): void => {
    const elapsed = now - this.last;
    this.last = now;
    try {
      this.step(now, this.rested ? Math.min(elapsed, FRAME_MS) : elapsed);
    } finally {
      // Also behind a step that failed: the next one may not.
      this.rested = performance.now() > this.awakeUntil;
      if (this.rested) this.timer = setTimeout(this.ask, REST_MS);
      else this.ask();
    }
  };
}

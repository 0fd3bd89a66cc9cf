/** Dynamic resolution of the local picture while it moves: fewer faces, then fewer pixels, where pictures come too slowly, more pixels where there is room. */

/** Device pixels to draw for each CSS pixel, one way. More than two nobody sees, and each costs. */
export const screenPixelRatio = () => Math.min(window.devicePixelRatio || 1, 2);

/** Shares of `screenPixelRatio`; slow machines go down this list. */
const SCALES = [1, 0.75, 0.55, 0.4, 0.3];
/** The time between pictures [ms] at which steps are taken. Thirty a second are the least that feels attached to the hand. */
const SLOW_FRAME_MS = 32;
const AIMED_FRAME_MS = 25;
const QUICK_FRAME_MS = 17.5;
const FRAMES_BEFORE_STEP = 4;

export class DynamicResolution {
  /** Running mean of the time between two moving pictures. */
  private frameMs = AIMED_FRAME_MS;
  private framesMeasured = 0;

  /** Goes up and down a list of sharpnesses, from one of its places. */
  constructor(
    private readonly scales: readonly number[] = SCALES,
    private step = 0,
  ) {}

  /** Share of the screen's own sharpness, or what else the list is of. */
  get scale(): number {
    return this.scales[this.step]!;
  }

  /** Take in the time since the last moving picture; true where the scale changed. */
  measure(elapsedMs: number): boolean {
    this.frameMs += 0.4 * (Math.min(elapsedMs, 500) - this.frameMs);
    if (++this.framesMeasured < FRAMES_BEFORE_STEP || (this.frameMs < SLOW_FRAME_MS && this.frameMs > QUICK_FRAME_MS)) return false;
    // A screen shows no more than sixty a second, so how much room there is cannot be measured: try one step, at less than twice the time.
    const next = this.frameMs <= QUICK_FRAME_MS ? Math.max(0, this.step - 1) : this.fitting();
    this.framesMeasured = 0;
    if (next === this.step) return false;
    this.step = next;
    this.frameMs = AIMED_FRAME_MS; // measure anew before the next step
    return true;
  }

  /** The first step whose pictures should come in time: time goes with the number of pixels. */
  private fitting(): number {
    const wanted = this.scale * Math.sqrt(AIMED_FRAME_MS / this.frameMs);
    const step = this.scales.findIndex((scale) => scale <= wanted * 1.05);
    return step < 0 ? this.scales.length - 1 : step;
  }
}

/** The time between pictures in motion [ms] beyond which a machine is slow. */
const SLOW_MOTION_MS = 50;
/** What one picture says of that, so that no hitch makes a machine slow ... */
const SHARE_OF_PICTURE = 0.15;
/** ... nor three in a row, however long they lasted [ms]. */
const LONGEST_MS = 2 * SLOW_MOTION_MS;

/**
 * Finds machines that are too slow for all of a mesh's faces. By the mean, not by each picture: browsers draw behind the page's back and may
 * hold up every second picture for both.
 */
export class SlowMotion {
  private frameMs = 1000 / 60;
  private found = false;

  /** Once found, a machine stays slow. */
  get slow(): boolean {
    return this.found;
  }

  /** Take in the time since the last moving picture. */
  measure(elapsedMs: number): void {
    this.frameMs += SHARE_OF_PICTURE * (Math.min(elapsedMs, LONGEST_MS) - this.frameMs);
    this.found ||= this.frameMs > SLOW_MOTION_MS;
  }
}

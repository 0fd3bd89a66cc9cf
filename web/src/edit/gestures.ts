/** Gestures: many small changes of one thing that are sent now and then, and undone in one step. */

import { isSplicing, sendEdit } from '../session/edit_log';
import type { Edit } from '../session/protocol.gen';

/** Edits of one gesture go out at most this often. */
const DRAG_INTERVAL_MS = 40;
/** Changes of the same thing that are closer together than this are one gesture. */
const GESTURE_MS = 500;

/** A key that no other gesture has, on this page or another. */
export const newKey = () => crypto.getRandomValues(new Uint32Array(3)).join('-');

let gesture = { name: '', key: '', at: -Infinity };

/** The same key for as long as the same thing is changed without a pause. */
export function keyOfGesture(name: string): string {
  const at = performance.now();
  const goesOn = name === gesture.name && at - gesture.at < GESTURE_MS;
  gesture = { name, key: goesOn ? gesture.key : newKey(), at };
  return gesture.key;
}

interface Throttle {
  /** To be sent next. */
  edit: Edit | null;
  key: string;
}
/** By the name of what is being changed. */
const throttles = new Map<string, Throttle>();

/** Send now; while edits of this name go on, the newest of them every DRAG_INTERVAL_MS. */
export function sendThrottled(name: string, edit: Edit, key = keyOfGesture(name)): void {
  const known = throttles.get(name);
  if (known) {
    // The last edit of an earlier gesture has its own place in the log.
    if (known.edit && known.key !== key) sendEdit(known.edit, known.key);
    known.edit = edit;
    known.key = key;
    return;
  }
  const throttle: Throttle = { edit, key };
  throttles.set(name, throttle);
  const step = () => {
    if (!isSplicing()) {
      if (!throttle.edit) return void throttles.delete(name);
      sendEdit(throttle.edit, throttle.key);
      throttle.edit = null;
    }
    window.setTimeout(step, DRAG_INTERVAL_MS);
  };
  step();
}

/**
 * The open session's edit log as this page sees it: the server's log, edits on their way there, and a draft of what it will be.
 *
 * An edit at the log's end is sent at once. Any other change is a splice, which counts places in the log: it is shown as a draft, sent
 * once everything before it is answered, and only one is under way. What the user does meanwhile is queued, for it counts in the log
 * that will be: a change of the edits is a function of them, which is called again when its turn comes.
 */

import { batch, computed, signal } from '@preact/signals';
import { difference, sameEdits, withReplaced } from './edit_list';
import { notify } from './notices';
import type { Edit, EditLog, ListChange, LogChangeMessage } from './protocol.gen';
import type { Stream } from './stream';
import { holdsLongWeights, withWeightFiles } from './weights';

export const log = signal<EditLog>({ revision: 0, edits: [], can_undo: false, can_redo: false, appended: 0, undone: [] });

export interface PendingEdit {
  /** Of its message. */
  id: number;
  edit: Edit;
  /** Once accepted: the revision whose log holds it. */
  revision: number | null;
}
/** Edits sent but not yet in `log`. */
export const pending = signal<PendingEdit[]>([]);
/** What the log will be, while a splice is under way or a slider is dragged whose edit is sent when it is let go. */
export const draft = signal<Edit[] | null>(null);

/** Place in the log's edits -> why the server skips the edit there. */
export const broken = computed(() => new Map((log.value.broken ?? []).map(({ index, reason }) => [index, reason])));
/** The log's edits without those that the server skips. */
export const appliedEdits = () => log.value.edits.filter((_, place) => !broken.value.has(place));

const sent = () => [...log.value.edits, ...pending.value.map(({ edit }) => edit)];
/** A change of the edits; it may be called more than once. */
type Revise = (edits: Edit[]) => Edit[];
/** What the user did while a splice was under way, to be done when it is answered: a revision, or whatever else. */
type Queued = { revise: Revise; key: string | null } | (() => void);
const queue = signal<Queued[]>([]);
const isRevision = (queued: Queued | undefined): queued is Exclude<Queued, () => void> => typeof queued === 'object';

/** What `now` will be, as far as it is known: what an undo that waits takes back is the server's to say. */
function revised(now: Edit[]): Edit[] {
  for (const queued of queue.value) {
    if (!isRevision(queued)) break;
    now = queued.revise(now);
  }
  return now;
}

/** The edits in force on this page, so that a slider never jumps back to what the server still says. */
export const edits = computed<Edit[]>(() => revised(draft.value ?? sent()));

interface Splice {
  after: Edit[];
  /** Splices that share one are one step of undo. */
  coalesce: string | null;
  /** Of its message, once that is sent. */
  id: number | null;
  /** Its painted weights are on their way to the server, before it. */
  uploading: boolean;
  /** Left, should another viewer change the log meanwhile. */
  attempts: number;
}
/** The one that the server has not answered yet. */
let splice: Splice | null = null;
const enqueue = (next: Queued) => void (queue.value = [...queue.value, next]);

/** Of the history's edits, as many as shall be in force once those on their way are in the log. */
let wanted: number | null = null;

let stream: Stream | null = null;

/** Where changes go; null: nowhere, no asset is open. */
export const attachStream = (next: Stream | null) => void (stream = next);

// ---- what the server says ------------------------------------------------------------------------------------------------

export function receiveLog(next: EditLog): void {
  batch(() => {
    log.value = next;
    pending.value = pending.value.filter(({ revision }) => revision === null || revision > next.revision);
  });
  goOn();
}

/** A change of the log; false where it was made to another log than this page has, which must then ask for the whole. */
export function receiveChange({ before, edits, undone, ...next }: LogChangeMessage): boolean {
  const now = log.value;
  if (now.digest !== before) return false;
  receiveLog({ revision: next.revision, digest: next.digest, can_undo: next.can_undo, can_redo: next.can_redo, appended: next.appended, broken: next.broken, edits: spliced(now.edits, edits), undone: spliced(now.undone, undone) });
  return true;
}

const spliced = (list: Edit[], { start, remove, edits }: ListChange): Edit[] => [...list.slice(0, start), ...edits, ...list.slice(start + remove)];

export function receiveAccepted(id: number, revision: number): void {
  pending.value = pending.value.map((waiting) => (waiting.id === id ? { ...waiting, revision } : waiting));
  receiveLog(log.value);
  if (id === splice?.id) endSplice();
  else sendSplice();
}

/** `overtaken`: another viewer changed the log first. Returns whether the change is given up; else it is tried again. */
export function receiveRejected(id: number, overtaken: boolean): boolean {
  if (overtaken && splice?.id === id && splice.attempts-- > 0) {
    splice.id = null;
    sendSplice();
    return false;
  }
  dropSplice();
  pending.value = pending.value.filter((waiting) => waiting.id !== id);
  goOn();
  return true;
}

/** Begin with another session's log. */
export function resetLog(next: EditLog): void {
  log.value = next;
  forgetUnsent();
}

/** Nothing is on its way any more. */
export function forgetUnsent(): void {
  pending.value = [];
  wanted = null;
  dropSplice();
}

/** Every edit that the user has made, wherever it is on its way. */
export const editsToRestore = () => revised(splice?.after ?? sent());

// ---- edits at the end ----------------------------------------------------------------------------------------------------

/** Append an edit. Those that share a `coalesce` key are one step of undo. */
export function sendEdit(edit: Edit, coalesce: string | null): void {
  if (!stream) return;
  const last = pending.value.at(-1)?.edit ?? log.value.edits.at(-1);
  // Enter behind a number that is in force already, and stays so: an undo, a redo or a splice on its way may take it back.
  const stays = !splice && !stream.awaits('undo') && !stream.awaits('redo');
  if (stays && last && sameEdits([last], [edit])) return;
  wanted = null; // what the user does last counts
  const id = stream.sendEdit(edit, coalesce);
  pending.value = [...pending.value, { id, edit, revision: null }];
}

// ---- other changes: splices ----------------------------------------------------------------------------------------------

export const isSplicing = () => splice !== null;

/**
 * Change the edits, in one step of undo; as fast as the server takes it. Of one gesture (`key`), a revision that is still queued gives way
 * to the next, so each must say all that the last one said. A gesture is one step of undo.
 */
export function reviseEdits(revise: Revise, key: string | null = null): void {
  if (splice) {
    const last = queue.value.at(-1);
    if (key !== null && isRevision(last) && last.key === key) queue.value = queue.value.slice(0, -1);
    return enqueue({ revise, key });
  }
  if (!stream) return;
  const after = revise(draft.value ?? sent());
  splice = { after, coalesce: key, id: null, uploading: false, attempts: 3 };
  draft.value = after;
  sendSplice();
}

/** Show what `edit` does in place of the newest one that it replaces; the server hears of it by `commitDraft`. */
export function draftEdit(edit: Edit, replaces: (other: Edit) => boolean): void {
  if (splice) return enqueue(() => draftEdit(edit, replaces));
  draft.value = withReplaced(sent(), edit, replaces);
}

export function commitDraft(): void {
  if (splice) enqueue(commitDraft);
  else if (draft.value) reviseEdits((now) => now);
}

/** Send the splice under way, if everything before it is answered: only then are the places known that it counts. */
export function sendSplice(): void {
  if (!splice || splice.id !== null || splice.uploading || !stream?.idle) return;
  const { edits: before, revision } = log.value;
  const { start, remove, edits: put } = difference(before, splice.after);
  if (remove === 0 && put.length === 0) return endSplice();
  if (holdsLongWeights(put)) return void upload(splice);
  splice.id = stream.splice(revision, start, remove, put, splice.coalesce);
}

/** Painted weights first, then the edits that refer to them. */
async function upload(current: Splice): Promise<void> {
  current.uploading = true;
  try {
    const after = await withWeightFiles(current.after);
    if (splice !== current) return;
    current.after = draft.value = after;
    current.uploading = false;
    sendSplice();
  } catch (error) {
    if (splice === current) dropSplice();
    notify((error as Error).message);
  }
}

function endSplice(): void {
  batch(() => {
    splice = null;
    draft.value = null;
    while (!splice && queue.value.length) {
      const [next, ...rest] = queue.value;
      queue.value = rest;
      if (isRevision(next)) reviseEdits(next.revise, next.key);
      else next!();
    }
  });
}

function dropSplice(): void {
  batch(() => {
    splice = null;
    queue.value = [];
    draft.value = null;
  });
}

// ---- history -------------------------------------------------------------------------------------------------------------

export function undo(): void {
  if (splice) enqueue(undo);
  else if (log.value.can_undo || pending.value.length || stream?.awaits('redo')) stream?.undo();
}

export function redo(): void {
  if (splice) enqueue(redo);
  else if (log.value.can_redo || stream?.awaits('undo')) stream?.redo();
}

/** To the log with `count` of the edits that the history shows in force. */
export function goTo(count: number): void {
  if (splice) return enqueue(() => goTo(count));
  if (pending.value.length) return void (wanted = count); // the history's places count in a log that holds them
  const { edits: now, appended } = log.value;
  if (now.length - count > appended) return reviseEdits(() => now.slice(0, count));
  for (let steps = now.length - count; steps > 0; steps--) stream?.undo();
  for (let steps = count - now.length; steps > 0; steps--) stream?.redo();
}

function goOn(): void {
  if (wanted === null || pending.value.length) return;
  const count = wanted;
  wanted = null;
  goTo(count);
}

/** The open asset: what the user does becomes messages on the stream, what the server says becomes signals. */

import { batch } from '@preact/signals';
import * as api from './api';
import { difference, environmentEdit, sameEdits, sameSelection, withoutValue, withReplaced, type Light } from './edit_log';
import type { Edit, EditLog, FrameHeader, MaterialValues, PickedMessage, ServerHello, SessionInfo, Settings } from './protocol.gen';
import { attempt, connection, draft, edits, EVERYTHING, flash, light, log, mesh, mode, notify, pending, selection, session, settings, status, tool } from './state';
import { Stream } from './stream';

/** Edits of one gesture go out at most this often; the server makes one undo step of those that share a key. */
const DRAG_INTERVAL_MS = 40;
/** Changes of the same value that are closer together than this are one gesture. */
const GESTURE_MS = 500;

let stream: Stream | null = null;
let helloListener: ((hello: ServerHello) => void) | null = null;
let lastHello: ServerHello | null = null;
let frameListener: ((header: FrameHeader, picture: ImageBitmap, cameraNumber: number) => void) | null = null;

/** The viewport's two ears; set once. The viewport may come later than the first hello, which it is then told. */
export function listen(onHello: (hello: ServerHello) => void, onFrame: (header: FrameHeader, picture: ImageBitmap, cameraNumber: number) => void): void {
  helloListener = onHello;
  frameListener = onFrame;
  if (lastHello) onHello(lastHello);
}

const storageKey = (asset: string) => `drgs.session.${asset}`;

/** Open an asset in the session that this browser last had on it, else in a new one. */
export async function openAsset(id: string): Promise<void> {
  const earlier = localStorage.getItem(storageKey(id));
  let info = earlier ? await api.getSession(earlier).catch(() => null) : null;
  if (info?.asset !== id) info = await attempt(freshSession(id));
  if (!info) return;
  localStorage.setItem(storageKey(id), info.id);
  stream?.close();
  lastHello = null;
  batch(() => {
    session.value = { id: info.id, asset: info.asset, assetName: info.asset_name };
    log.value = logOf(info);
    pending.value = [];
    status.value = null;
    mesh.value = null;
    dropSplice();
    selection.value = EVERYTHING;
    tool.value = 'all';
  });
  history.replaceState(null, '', `#asset=${encodeURIComponent(id)}`);
  document.title = `${info.asset_name} · DR-GS`;
  stream = new Stream(info.id, events(info.asset));
  stream.sendSettings(settings.value);
}

const logOf = ({ revision, edits, can_undo, can_redo, appended, undone }: SessionInfo): EditLog => ({ revision, edits, can_undo, can_redo, appended, undone });

/** A new session; where the server takes no more, the newest that it has on this asset. */
async function freshSession(asset: string): Promise<SessionInfo> {
  try {
    return await api.openSession(asset);
  } catch (error) {
    const full = error instanceof api.ApiError && error.status === 429;
    const other = full ? (await api.listSessions()).sessions.find((known) => known.asset === asset) : undefined;
    if (!other) throw error;
    return other;
  }
}

export function closeAsset(): void {
  stream?.close();
  stream = null;
  session.value = null;
  status.value = null;
  history.replaceState(null, '', location.pathname);
  document.title = 'DR-GS';
}

function events(asset: string): ConstructorParameters<typeof Stream>[1] {
  return {
    connection: (state) => (connection.value = state),
    hello: (hello) => {
      takeLog(hello.log);
      queueMicrotask(sendSplice); // one that waited for a connection
      lastHello = hello;
      helloListener?.(hello);
    },
    message: (message) => {
      switch (message.type) {
        case 'state':
          return takeLog(message.log);
        case 'accepted':
          pending.value = pending.value.map((waiting) => (waiting.id === message.id ? { ...waiting, revision: message.revision } : waiting));
          takeLog(log.value);
          return message.id === splicing?.id ? endSplice() : sendSplice();
        case 'rejected':
          if (message.overtaken && splicing?.id === message.id && splicing.attempts-- > 0) {
            splicing.id = null;
            return sendSplice();
          }
          dropSplice();
          pending.value = pending.value.filter((waiting) => waiting.id !== message.id);
          return notify(message.reason);
        case 'status':
          status.value = message;
          return;
        case 'error':
          return notify(message.message);
      }
    },
    frame: (header, picture, cameraNumber) => (frameListener ? frameListener(header, picture, cameraNumber) : picture.close()),
    refused: (reason) => {
      connection.value = 'closed';
      notify(reason);
    },
    lost: () => recoverSession(asset),
  };
}

/** After a lost connection: the same session if the server still has it, else a new one that is given all edits again. */
async function recoverSession(asset: string): Promise<string | null> {
  const open = session.value;
  if (!open || open.asset !== asset) return null;
  try {
    await api.getSession(open.id);
    return null;
  } catch (error) {
    if (!(error instanceof api.ApiError) || error.status !== 404) {
      if (error instanceof api.ApiError && error.status === 401) notify(error.message);
      return null; // the server is away: keep asking
    }
  }
  try {
    const wanted = splicing?.after ?? [...log.value.edits, ...pending.value.map((waiting) => waiting.edit)];
    const fresh = await api.openSession(asset);
    for (const edit of wanted) await api.appendEdit(fresh.id, edit);
    localStorage.setItem(storageKey(asset), fresh.id);
    batch(() => {
      session.value = { ...open, id: fresh.id };
      pending.value = [];
      dropSplice();
    });
    return fresh.id;
  } catch {
    return null;
  }
}

function takeLog(next: EditLog): void {
  batch(() => {
    log.value = next;
    pending.value = pending.value.filter((waiting) => waiting.revision === null || waiting.revision > next.revision);
  });
}

// ---- edits -------------------------------------------------------------------------------------------------------------

interface Flow {
  next: Edit | null;
  key: string;
}
const flows = new Map<string, Flow>();

let gesture = { name: '', key: '', at: -Infinity };

/** The same key for as long as the same thing is changed without a pause. */
export function keyOfGesture(name: string): string {
  const at = performance.now();
  const goesOn = name === gesture.name && at - gesture.at < GESTURE_MS;
  gesture = { name, key: goesOn ? gesture.key : newKey(), at };
  return gesture.key;
}

/** That of no other gesture, of no other page. */
export const newKey = () => crypto.getRandomValues(new Uint32Array(3)).join('-');

function send(edit: Edit, coalesce: string | null): void {
  if (!stream) return;
  const last = pending.value.at(-1)?.edit ?? log.value.edits.at(-1);
  if (last && sameEdits([last], [edit])) return; // Enter behind a number that is in force already
  const id = stream.sendEdit(edit, coalesce);
  pending.value = [...pending.value, { id, edit, revision: null }];
}

/** Send now, or, while edits of this name are flowing, the newest of them every DRAG_INTERVAL_MS. */
function sendFlowing(name: string, edit: Edit, key = keyOfGesture(name)): void {
  const flowing = flows.get(name);
  if (flowing) {
    // The last one of a gesture that is over has its own place in the log.
    if (flowing.next && flowing.key !== key) send(flowing.next, flowing.key);
    flowing.next = edit;
    flowing.key = key;
    return;
  }
  const flow: Flow = { next: edit, key };
  flows.set(name, flow);
  const step = () => {
    if (!splicing && !flow.next) return void flows.delete(name);
    if (!splicing && flow.next) {
      send(flow.next, flow.key);
      flow.next = null;
    }
    window.setTimeout(step, DRAG_INTERVAL_MS);
  };
  step();
}

/** Set values of the selected part. Multiplying edits, and painted ones, which are long, are sent when the slider is let go. */
export function editMaterial(set: MaterialValues): void {
  const select = selection.value;
  const edit: Edit = { op: 'material', select, set, mode: mode.value };
  const keys = Object.keys(set).join('+');
  if (mode.value === 'absolute' && !select.vertex_weights) return sendFlowing(`material.${keys}.${flash.value}`, edit);
  const wanted = Object.keys(set).sort().join();
  draftEdit(edit, (other) => other.op === 'material' && other.mode === edit.mode && sameSelection(select, other.select) && keysOf(other.set) === wanted);
}

const keysOf = (set: MaterialValues) => (Object.keys(set) as (keyof MaterialValues)[]).filter((key) => set[key] != null).sort().join();

export function resetMaterial(key: keyof MaterialValues): void {
  replaceEdits(withoutValue(edits.value, selection.value, key));
}

/** `key`: of a gesture that lasts until the hand lets go, however slowly it moves. */
export function editLight(change: Partial<Light>, key?: string): void {
  sendFlowing(`light.${Object.keys(change).join('+')}`, environmentEdit({ ...light.value, ...change }), key);
}

/** The asset's own environment again. An edit without a file keeps the one in force, so those that named one must go. */
export function useCapturedLight(): void {
  const { rotation, intensity } = light.value;
  const others = edits.value.filter((edit) => edit.op !== 'environment');
  replaceEdits(rotation || intensity !== 1 ? [...others, environmentEdit({ file: null, rotation, intensity })] : others);
}

export const isTwin = (edit: Edit) => (other: Edit) => edit.op === 'deform' && other.op === 'deform' && edit.map != null && edit.map.type === other.map?.type;

interface Change {
  after(edits: Edit[]): Edit[];
  key: string;
}
/** The newest one that is not sent yet. */
let waiting: Change | null = null;

/**
 * Change the log as the server takes it: with one key, a film or a drag is one step of undo. Changes that the server has no time for are
 * left out, so each one must say all that the last one said.
 */
export function changeFlowing(after: (edits: Edit[]) => Edit[], key: string): void {
  if (waiting?.key === key) return void (waiting.after = after);
  if (!splicing) return replaceEdits(after(edits.value), key);
  const change: Change = { after, key };
  waiting = change; // the last one of a gesture that is over keeps its own place
  later.push(() => {
    if (waiting === change) waiting = null;
    replaceEdits(change.after(edits.value), change.key);
  });
}

/** Another moment of what moves, in place of the last one. */
export const editTime = (edit: Edit, key: string) => changeFlowing((now) => withReplaced(now, edit, (other) => other.op === edit.op), key);

// ---- edits that take an earlier one's place ------------------------------------------------------------------------------

/** Show what `edit` does, in place of the newest one that it replaces; the server hears of it by `commitDraft`. */
export function draftEdit(edit: Edit, replaces: (other: Edit) => boolean): void {
  if (splicing) return void later.push(() => draftEdit(edit, replaces));
  draft.value = withReplaced([...log.value.edits, ...pending.value.map((waiting) => waiting.edit)], edit, replaces);
}

export function commitDraft(): void {
  if (splicing) later.push(commitDraft);
  else if (draft.value) replaceEdits(draft.value);
}

interface Splicing {
  after: Edit[];
  coalesce: string | null;
  /** Of its message, once that is sent. */
  id: number | null;
  /** Left, should another viewer change the log meanwhile. */
  attempts: number;
}
/** The one that the server has not answered yet. */
let splicing: Splicing | null = null;
/** What the user did meanwhile, to be done then: it counts in the log that will be. */
let later: (() => void)[] = [];

/** Make the log hold exactly these edits, in one step of undo. */
export function replaceEdits(after: Edit[], coalesce: string | null = null): void {
  if (splicing) return void later.push(() => replaceEdits(after, coalesce));
  if (!stream) return;
  splicing = { after, coalesce, id: null, attempts: 3 };
  draft.value = after;
  sendSplice();
}

/** Once all changes before it are answered: only then is it known what it counts in. */
function sendSplice(): void {
  if (!splicing || splicing.id !== null || !stream?.idle) return;
  const { after, coalesce } = splicing;
  const { edits: now, revision } = log.value;
  const { start, remove, edits: put } = difference(now, after);
  if (remove === 0 && put.length === 0) return endSplice();
  splicing.id = stream.splice(revision, start, remove, put, coalesce);
}

function endSplice(): void {
  splicing = null; // first: who hears of the draft's end must find none under way
  draft.value = null;
  while (!splicing && later.length) later.shift()!();
}

/** What is waiting to become of the log is wanted no more, or can't be. */
function dropSplice(): void {
  splicing = waiting = null;
  later = [];
  draft.value = null;
}

export function undo(): void {
  if (splicing) later.push(undo);
  else if (log.value.can_undo || pending.value.length || stream?.awaits('redo')) stream?.undo();
}

export function redo(): void {
  if (splicing) later.push(redo);
  else if (log.value.can_redo || stream?.awaits('undo')) stream?.redo();
}

/** To the log with `count` of the edits that the history shows in force. */
export function goTo(count: number): void {
  if (splicing) return void later.push(() => goTo(count));
  const { edits: now, appended } = log.value;
  if (now.length - count > appended) return replaceEdits(now.slice(0, count));
  for (let steps = now.length - count; steps > 0; steps--) stream?.undo();
  for (let steps = count - now.length; steps > 0; steps--) stream?.redo();
}

export function changeSettings(change: Partial<Settings>): void {
  settings.value = { ...settings.value, ...change };
  stream?.sendSettings(settings.value);
}

export function sendCamera(camera: Parameters<Stream['sendCamera']>[0]): number | null {
  return stream ? stream.sendCamera(camera) : null;
}

export function pick(x: number, y: number): Promise<PickedMessage> | null {
  return stream ? stream.pick(x, y) : null;
}

/** The open asset: what the user does becomes messages on the stream, what the server says becomes signals. */

import { batch } from '@preact/signals';
import * as api from './api';
import { environmentEdit, type Light } from './edit_log';
import type { Edit, EditLog, FrameHeader, MaterialValues, PickedMessage, ServerHello, SessionInfo, Settings } from './protocol.gen';
import { attempt, captured, connection, light, log, notify, pending, session, settings, status } from './state';
import { Stream } from './stream';

/** Edits of one drag go out at most this often; the server makes one undo step of those that share a key. */
const DRAG_INTERVAL_MS = 40;

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
    log.value = { revision: info.revision, edits: info.edits, can_undo: info.can_undo, can_redo: info.can_redo };
    pending.value = [];
    status.value = null;
    captured.value = null;
  });
  history.replaceState(null, '', `#asset=${encodeURIComponent(id)}`);
  document.title = `${info.asset_name} · DR-GS`;
  stream = new Stream(info.id, events(info.asset));
  stream.sendSettings(settings.value);
}

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
      lastHello = hello;
      helloListener?.(hello);
    },
    message: (message) => {
      switch (message.type) {
        case 'state':
          return takeLog(message.log);
        case 'accepted':
          pending.value = pending.value.map((waiting) => (waiting.id === message.id ? { ...waiting, revision: message.revision } : waiting));
          return takeLog(log.value);
        case 'rejected':
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
    const wanted = [...log.value.edits, ...pending.value.map((waiting) => waiting.edit)];
    const fresh = await api.openSession(asset);
    for (const edit of wanted) await api.appendEdit(fresh.id, edit);
    localStorage.setItem(storageKey(asset), fresh.id);
    batch(() => {
      session.value = { ...open, id: fresh.id };
      pending.value = [];
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

interface Drag {
  timer: number;
  next: Edit | null;
}
const drags = new Map<string, Drag>();

function send(edit: Edit, coalesce: string | null): void {
  if (!stream) return;
  const id = stream.sendEdit(edit, coalesce);
  pending.value = [...pending.value, { id, edit, revision: null }];
}

/** Send now, or, while edits of this key are flowing, the newest of them every DRAG_INTERVAL_MS. */
function sendFlowing(key: string, edit: Edit): void {
  const drag = drags.get(key);
  if (drag) {
    drag.next = edit;
    return;
  }
  const flow: Drag = { timer: 0, next: null };
  drags.set(key, flow);
  const step = () => {
    if (flow.next) {
      send(flow.next, key);
      flow.next = null;
      flow.timer = window.setTimeout(step, DRAG_INTERVAL_MS);
    } else drags.delete(key);
  };
  send(edit, key);
  flow.timer = window.setTimeout(step, DRAG_INTERVAL_MS);
}

export function editMaterial(set: MaterialValues): void {
  sendFlowing(`material.${Object.keys(set).join('+')}`, { op: 'material', select: { all: true }, set, mode: 'absolute' });
}

export function editLight(change: Partial<Light>): void {
  sendFlowing(`light.${Object.keys(change).join('+')}`, environmentEdit({ ...light.value, ...change }));
}

export function undo(): void {
  if (log.value.can_undo || pending.value.length) stream?.undo();
}

export function redo(): void {
  if (log.value.can_redo) stream?.redo();
}

/** Back to the log with `count` edits in force, by that many undo steps. */
export function undoTo(count: number): void {
  for (let steps = log.value.edits.length - count; steps > 0; steps--) stream?.undo();
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

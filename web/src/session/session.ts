/** The open asset: its session on the server and the stream to it. What arrives there is handed to whoever it concerns. */

import { batch, computed, signal } from '@preact/signals';
import * as api from './api';
import { attachStream, editsToRestore, forgetUnsent, receiveAccepted, receiveChange, receiveLog, receiveRejected, resetLog, sendSplice } from './edit_log';
import { noteWaiting } from './long_change';
import { attempt, notify } from './notices';
import { preference } from './preferences';
import type { EditLog, FrameHeader, PickedMessage, ServerHello, SessionInfo, Settings, StatusMessage } from './protocol.gen';
import { Stream, type Connection, type StreamEvents } from './stream';

export interface OpenSession {
  id: string;
  asset: string;
  assetName: string;
}
export const session = signal<OpenSession | null>(null);
/** Id of the open asset: the same while a lost session is replaced by a new one. */
export const openedAsset = computed(() => session.value?.asset ?? null);
export const connection = signal<Connection>('closed');
/** What the server says of its newest picture. */
export const status = signal<StatusMessage | null>(null);
/** What machines of different speed choose once. */
const samplesAPixel = preference('samplesAPixel', 256);
export const settings = signal<Required<Settings>>({ exposure_stops: 0, tone_curve: 'standard', background: 'environment', spp_target: samplesAPixel.value, bounces: 1, channel: 'final', denoise: true, turn_light: false });
/** Rows of the first photograph's rotation, world from camera, where the opened asset's own light stood still with the camera; null: with the object. */
export const lightCamera = signal<NonNullable<ServerHello['light_camera']> | null>(null);

let stream: Stream | null = null;
type HelloListener = (hello: ServerHello) => void;
type FrameListener = (header: FrameHeader, picture: ImageBitmap, cameraNumber: number) => void;
let helloListener: HelloListener | null = null;
let frameListener: FrameListener | null = null;
let lastHello: ServerHello | null = null;

/** Set once, by the viewport. A hello that came before it is repeated to it. */
export function listen(onHello: HelloListener, onFrame: FrameListener): void {
  helloListener = onHello;
  frameListener = onFrame;
  if (lastHello) onHello(lastHello);
}

const storageKey = (asset: string) => `drgs.session.${asset}`;

/** Have the server give up the change that it is computing. */
export const cancelChange = () => stream?.cancelChange();

/** Open an asset in the session that this browser last had on it, else in a new one. */
export async function openAsset(id: string): Promise<void> {
  const earlier = localStorage.getItem(storageKey(id));
  let info = earlier ? await api.getSession(earlier).catch(() => null) : null;
  if (info?.asset !== id) info = await attempt(freshSession(id));
  if (!info) return;
  localStorage.setItem(storageKey(id), info.id);
  stream?.close();
  noteWaiting(0);
  lastHello = null;
  batch(() => {
    session.value = { id: info.id, asset: info.asset, assetName: info.asset_name };
    resetLog(logOf(info));
    status.value = null;
    lightCamera.value = null;
  });
  history.replaceState(null, '', `#asset=${encodeURIComponent(id)}`);
  document.title = `${info.asset_name} · DR-GS`;
  stream = new Stream(info.id, events(info.asset));
  attachStream(stream);
  stream.sendSettings(settings.value);
}

const logOf = ({ revision, edits, can_undo, can_redo, appended, undone, broken }: SessionInfo): EditLog => ({ revision, edits, can_undo, can_redo, appended, undone, broken });

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

function events(asset: string): StreamEvents {
  return {
    connection: (state) => (connection.value = state),
    waiting: noteWaiting,
    hello: (hello) => {
      receiveLog(hello.log);
      queueMicrotask(sendSplice); // one that waited for a connection
      lastHello = hello;
      lightCamera.value = hello.light_camera ?? null;
      helloListener?.(hello);
    },
    message: (message) => {
      switch (message.type) {
        case 'state':
          return receiveLog(message.log);
        case 'change':
          return receiveChange(message) ? undefined : stream?.askForLog();
        case 'accepted':
          return receiveAccepted(message.id, message.revision);
        case 'rejected':
          return receiveRejected(message.id, message.overtaken) ? notify(message.reason) : undefined;
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

/** After a lost connection: null while the server may still have the session, else the id of a new one that was given all edits. */
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
    const wanted = editsToRestore();
    const fresh = await api.openSession(asset);
    for (const edit of wanted) await api.appendEdit(fresh.id, edit);
    localStorage.setItem(storageKey(asset), fresh.id);
    batch(() => {
      session.value = { ...open, id: fresh.id };
      forgetUnsent();
    });
    return fresh.id;
  } catch {
    return null;
  }
}

export function changeSettings(change: Partial<Settings>): void {
  settings.value = { ...settings.value, ...change };
  samplesAPixel.value = settings.value.spp_target;
  stream?.sendSettings(settings.value);
}

/** The number by which frames will name this camera; null while no asset is open. */
export function sendCamera(camera: Parameters<Stream['sendCamera']>[0]): number | null {
  return stream ? stream.sendCamera(camera) : null;
}

/** While true, no traced pictures are wanted. */
export const holdFrames = (hold: boolean) => stream?.holdFrames(hold);

/** What lies under a point of the picture, given as shares of its width and height; null while no asset is open. */
export function pick(x: number, y: number): Promise<PickedMessage> | null {
  return stream ? stream.pick(x, y) : null;
}

/** What the page knows, as signals: one copy each, read by panels and viewport, written only by session.ts, jobs.ts and the panels' own switches. */

import { computed, effect, signal } from '@preact/signals';
import { lightOf, wholeObjectMaterial } from './edit_log';
import type { MaterialMean } from './local_picture';
import type { AssetInfo, Edit, EditLog, EnvironmentInfo, JobInfo, Settings, StatusMessage } from './protocol.gen';
import type { Connection } from './stream';

export const assets = signal<AssetInfo[] | null>(null);
export const environments = signal<EnvironmentInfo[]>([]);
export const jobs = signal<JobInfo[]>([]);
export const workersAlive = signal(1);

export interface OpenSession {
  id: string;
  asset: string;
  assetName: string;
}
export const session = signal<OpenSession | null>(null);
export const connection = signal<Connection>('closed');
export const status = signal<StatusMessage | null>(null);

/** The server's log, and edits sent but not yet in it: panels show both, so a slider never jumps back. */
export const log = signal<EditLog>({ revision: 0, edits: [], can_undo: false, can_redo: false });
export interface PendingEdit {
  id: number;
  edit: Edit;
  /** Once accepted: the revision whose log holds it. */
  revision: number | null;
}
export const pending = signal<PendingEdit[]>([]);
export const edits = computed<Edit[]>(() => [...log.value.edits, ...pending.value.map((waiting) => waiting.edit)]);
export const material = computed(() => wholeObjectMaterial(edits.value));
export const light = computed(() => lightOf(edits.value));

/** Mean of the mesh's captured materials; null until the mesh is here. */
export const captured = signal<MaterialMean | null>(null);

export const settings = signal<Required<Settings>>({ exposure_stops: 0, background: 'environment', spp_target: 256, bounces: 1, channel: 'final', denoise: true });

export interface Notice {
  id: number;
  kind: 'error' | 'info';
  text: string;
}
export const notices = signal<Notice[]>([]);
let noticeCount = 0;

export function notify(text: string, kind: Notice['kind'] = 'error'): void {
  if (notices.value.some((notice) => notice.text === text)) return;
  const notice = { id: ++noticeCount, kind, text };
  notices.value = [...notices.value.slice(-3), notice];
  setTimeout(() => dismiss(notice.id), kind === 'error' ? 12_000 : 5_000);
}

export function dismiss(id: number): void {
  notices.value = notices.value.filter((notice) => notice.id !== id);
}

/** Run something that may fail; a failure becomes a notice. */
export async function attempt<T>(work: Promise<T>): Promise<T | null> {
  try {
    return await work;
  } catch (error) {
    notify(error instanceof Error ? error.message : String(error));
    return null;
  }
}

// ---- preferences, kept in this browser ---------------------------------------------------------------------------------

function kept<T>(name: string, initial: T) {
  const stored = localStorage.getItem(`drgs.${name}`);
  const value = signal<T>(stored === null ? initial : (JSON.parse(stored) as T));
  effect(() => localStorage.setItem(`drgs.${name}`, JSON.stringify(value.value)));
  return value;
}

export const theme = kept<'dark' | 'light'>('theme', matchMedia('(prefers-color-scheme: light)').matches ? 'light' : 'dark');
/** Draw the mesh locally until the traced frame arrives. */
export const localPicture = kept<boolean>('localPicture', true);
export const libraryOpen = kept<boolean>('libraryOpen', true);
export const inspectorOpen = kept<boolean>('inspectorOpen', true);
/** How many pixels the still picture may have. */
export const resolution = kept<'low' | 'medium' | 'full'>('resolution', 'medium');
export const helpOpen = signal(false);

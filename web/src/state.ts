/** What the page knows, as signals: one copy each, read by panels and viewport, written only by session.ts, jobs.ts and the panels' own switches. */

import { computed, effect, signal } from '@preact/signals';
import { lightOf } from './edit_log';
import { applyMaterials, meanMaterial, selectVertices, type MaterialMean, type RestMesh } from './materials';
import { presets, type NamedMaterial } from './presets';
import type { AssetInfo, Edit, EditLog, EnvironmentInfo, JobInfo, Selection, Settings, StatusMessage } from './protocol.gen';
import type { FilmView } from './film';
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
export const log = signal<EditLog>({ revision: 0, edits: [], can_undo: false, can_redo: false, appended: 0, undone: [] });
export interface PendingEdit {
  id: number;
  edit: Edit;
  /** Once accepted: the revision whose log holds it. */
  revision: number | null;
}
export const pending = signal<PendingEdit[]>([]);
/** While the log is being changed elsewhere than at its end, or a slider is dragged whose edit is sent at the end: what it will be. */
export const draft = signal<Edit[] | null>(null);
export const edits = computed<Edit[]>(() => draft.value ?? [...log.value.edits, ...pending.value.map((waiting) => waiting.edit)]);
export const light = computed(() => lightOf(edits.value));

/** The asset's mesh as captured; null until it is here. */
export const mesh = signal<RestMesh | null>(null);
export const materials = computed(() => mesh.value && applyMaterials(mesh.value, edits.value));

// ---- the part that material edits go to ---------------------------------------------------------------------------------

export type Tool = 'all' | 'region' | 'similar' | 'sphere' | 'box' | 'brush';
export const tool = signal<Tool>('all');
export const EVERYTHING: Selection = { all: true };
export const selection = signal<Selection>(EVERYTHING);
export const mode = signal<'absolute' | 'multiply'>('absolute');
/** Raised to let the selection flash. */
export const flash = signal(0);
/** While true the local picture shows material and shape as captured. */
export const before = signal(false);

const weights = computed(() => mesh.value && selectVertices(mesh.value, selection.value));
/** Share of the vertices that is selected. */
export const selectedShare = computed(() => (weights.value ? weights.value.reduce((sum, weight) => sum + weight, 0) / weights.value.length : 0));
export const selectionWeights = weights;
/** Mean of what is selected, with all edits. */
export const mean = computed<MaterialMean>(() => (materials.value && weights.value && meanMaterial(materials.value, weights.value)) || NEUTRAL);
const NEUTRAL: MaterialMean = { albedo: [0.5, 0.5, 0.5], roughness: 0.5, metallic: 0 };

export const settings = signal<Required<Settings>>({ exposure_stops: 0, tone_curve: 'standard', background: 'environment', spp_target: 256, bounces: 1, channel: 'final', denoise: true });

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
export type Tab = 'material' | 'light' | 'shape' | 'view' | 'out';
export const tab = kept<Tab>('tab', 'material');
/** (share of the job, dB) by job, as far as this browser saw it. */
export const psnrCurves = kept<Record<string, [number, number][]>>('psnr', {});
/** Length of clips that this browser ordered, by the job that made them [s]; a clip itself does not tell. */
export const clipSeconds = kept<Record<string, number>>('clipSeconds', {});
/** The views of each asset's film. */
export const films = kept<Record<string, FilmView[]>>('films', {});
export const savedMaterials = kept<NamedMaterial[]>('materials', []);
/** Shown in this order, each with a picture once the viewport has drawn it. */
export const ballsWanted = computed(() => [...presets, ...savedMaterials.value]);
export const balls = signal<string[]>([]);
/** Picture of the asset's own environment; null until it is here. */
export const capturedLight = signal<string | null>(null);
export const copiedMaterial = signal<MaterialMean | null>(null);
export const flying = signal(false);
export const helpOpen = signal(false);

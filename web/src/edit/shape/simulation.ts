/** The film of an object that falls: moments are edits that follow each other. What it is made of is matter.ts'. */

import { computed, effect, signal } from '@preact/signals';
import { withReplaced } from '../../session/edit_list';
import { draft, edits, pending, reviseEdits } from '../../session/edit_log';
import { isActive, jobName, jobs, startJob } from '../../session/jobs';
import { preference } from '../../session/preferences';
import type { Edit, JobInfo, PoseEdit, SimulateEdit } from '../../session/protocol.gen';
import { session } from '../../session/session';
import { newKey } from '../gestures';
import { FPS, matter, scene, sceneOf, seconds } from './matter';

/** Of a clip whose length this browser does not know [s]. */
const LONGEST_CLIP = 5;

// ---- films: simulated as they are shown, or clips that a worker made ---------------------------------------------------------

type Moment = SimulateEdit | PoseEdit;
const isMoment = (edit: Edit): edit is Moment => edit.op === 'simulate' || edit.op === 'pose';

/** The moment in force. */
export const moment = computed(() => edits.value.findLast(isMoment) ?? null);
export const playing = signal(false);
export const loop = signal(true);
/** Of life, as the panel's choice has it. */
export const speed = signal('1');

/** Length of clips that this browser ordered, by the job that made them [s]; a clip itself does not tell. */
const clipSeconds = preference<Record<string, number>>('clipSeconds', {});
const jobOfClip = (clip: string) => clip.replace(/^clips\//, '');
/** Jobs whose clips of the open asset can be played. */
export const clips = computed(() => jobs.value.filter((job) => job.kind === 'simulate' && job.clip !== null && job.source_asset === session.value?.asset));
/** Jobs that compute clips of the open asset now. */
export const baking = computed(() => jobs.value.filter((job) => job.kind === 'simulate' && job.source_asset === session.value?.asset && isActive(job)));

export const secondsOf = (edit: Moment) => (edit.op === 'simulate' ? Number(edit.scene.duration ?? 2) : (clipSeconds.value[jobOfClip(edit.clip)] ?? LONGEST_CLIP));

/** How much of a film there is to play [s]: of a clip that is being made, what is made; its first frame is at rest. */
function secondsMade(edit: Moment): number {
  const job = edit.op === 'pose' ? baking.value.find(({ id }) => id === jobOfClip(edit.clip)) : undefined;
  if (!job) return secondsOf(edit);
  return Math.max(0, (job.fraction * (secondsOf(edit) * FPS + 1) - 1) / FPS);
}

/** What a job makes, under the name that it will have. */
export const clipOf = (job: JobInfo) => `clips/${job.id}`;

/** One for each film: however slowly it plays, undo takes it away in one step. */
let filmKey = newKey();

export const simulate = () => start((now) => ({ op: 'simulate', scene: { ...sceneOf(now) }, time: 0 }));
export const playClip = (clip: string) => start(() => ({ op: 'pose', clip, time: 0 }));

/** From the first moment on, in place of whatever moved before. */
function start(first: (now: Edit[]) => Moment): void {
  filmKey = newKey();
  reviseEdits((now) => [...now.filter((other) => !isMoment(other)), first(now)], filmKey);
  playing.value = true;
}

export function removeMotion(): void {
  playing.value = false;
  reviseEdits((now) => now.filter((edit) => !isMoment(edit)));
}

/** Have a worker simulate all of it, so that the picture is not held up; the clip can then be played, and rendered by other jobs. */
export async function bake(): Promise<void> {
  const open = session.value!;
  const job = await startJob({ kind: 'simulate', asset: open.asset, name: jobName(open.assetName, matter.value), scene: scene.value });
  if (job) clipSeconds.value = { ...clipSeconds.value, [job.id]: seconds.value };
}

/** Show another moment. `key`: of the gesture. */
export function seek(edit: Moment, time: number, key: string): void {
  const next: Edit = { ...edit, time: Math.round(time * 1000) / 1000 };
  reviseEdits((now) => withReplaced(now, next, (other) => other.op === next.op), key);
}

// A film shows its next moment once the server has taken the last one: as fast as it is computed, never faster than life.
effect(() => {
  if (!playing.value || !session.value) return;
  let before = performance.now();
  const timer = setInterval(() => {
    const edit = moment.value;
    if (!edit || draft.value || pending.value.length > 0) return;
    const now = performance.now();
    const step = Math.min((now - before) / 1000, 2 / FPS) * Number(speed.value);
    before = now;
    const length = secondsMade(edit);
    // What is not made yet is waited for.
    if (edit.time + step > length && length < secondsOf(edit)) return;
    if (edit.time + step > length && !loop.value) playing.value = false;
    seek(edit, playing.value ? (edit.time + step) % length : length, filmKey);
  }, 1000 / FPS);
  return () => clearInterval(timer);
});

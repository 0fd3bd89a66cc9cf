/** The object as matter: what it is made of, how it falls, and the film of it, whose moments are edits that follow each other. */

import { computed, effect, signal } from '@preact/signals';
import { withReplaced } from '../../session/edit_list';
import { draft, edits, pending, replaceEdits, reviseEdits } from '../../session/edit_log';
import { isActive, jobName, jobs, startJob } from '../../session/jobs';
import { preference } from '../../session/preferences';
import type { Edit, PoseEdit, SimulateEdit } from '../../session/protocol.gen';
import { session } from '../../session/session';
import { newKey } from '../gestures';
import { bounds } from '../mesh';
import { pins } from './pins';

export const MATTERS = ['jelly', 'rubber', 'clay', 'sand', 'snow', 'honey'] as const;
export type Matter = (typeof MATTERS)[number];
/** Density [t/m³] and Poisson's ratio of each (drgs/deform/simulation_scene.py). A fluid has neither ratio nor stiffness. */
const MATTER_VALUES: Record<Matter, { density: number; poisson: number | null }> = {
  jelly: { density: 1, poisson: 0.3 },
  rubber: { density: 1.1, poisson: 0.4 },
  clay: { density: 1.8, poisson: 0.3 },
  sand: { density: 1.6, poisson: 0.2 },
  snow: { density: 0.4, poisson: 0.2 },
  honey: { density: 1.4, poisson: null },
};
/** Particles of a quick and a fine simulation. */
const PARTICLES = { quick: 4000, fine: 20_000 };
const FPS = 24;
/** Of a clip whose length this browser does not know [s]. */
const LONGEST_CLIP = 5;

// ---- what is to be simulated -----------------------------------------------------------------------------------------------

export const matter = signal<Matter>('jelly');
export const matterValues = computed(() => MATTER_VALUES[matter.value]);
/** log10 of Young's modulus [kPa]; null: the matter's, which follows the object's size. */
export const stiffness = signal<number | null>(null);
/** log10 of the density [t/m³]; null: the matter's. */
export const density = signal<number | null>(null);
/** Poisson's ratio; null: the matter's. */
export const poisson = signal<number | null>(null);
export const hasFloor = signal(true);
/** Over the floor, in heights of the object. */
export const dropHeight = signal(0.5);
/** Length of the film. */
export const seconds = signal(1.5);
export const fine = signal(false);

function scene(): Record<string, unknown> {
  const { minimum, maximum } = bounds.value;
  const solid = matterValues.value.poisson !== null;
  const made = {
    preset: matter.value,
    ...(solid && stiffness.value !== null && { young_modulus: 1000 * 10 ** stiffness.value }),
    ...(density.value !== null && { density: Number((1000 * 10 ** density.value).toPrecision(4)) }),
    ...(solid && poisson.value !== null && { poisson_ratio: poisson.value }),
  };
  const floor = hasFloor.value ? { height: minimum[2] - dropHeight.value * (maximum[2] - minimum[2]), friction: 0.5 } : null;
  return { matter: made, floor, ...(pins.value.length > 0 && { pins: pins.value }), duration: seconds.value, fps: FPS, particles: fine.value ? PARTICLES.fine : PARTICLES.quick };
}

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

/** One for each film: however slowly it plays, undo takes it away in one step. */
let filmKey = newKey();

export const simulate = () => start({ op: 'simulate', scene: scene(), time: 0 });
export const playClip = (clip: string) => start({ op: 'pose', clip, time: 0 });

/** From the first moment on, in place of whatever moved before. */
function start(edit: Moment): void {
  filmKey = newKey();
  replaceEdits([...edits.value.filter((other) => !isMoment(other)), edit], filmKey);
  playing.value = true;
}

export function removeMotion(): void {
  playing.value = false;
  replaceEdits(edits.value.filter((edit) => !isMoment(edit)));
}

/** Have a worker simulate all of it, so that the picture is not held up; the clip can then be played, and rendered by other jobs. */
export async function bake(): Promise<void> {
  const open = session.value!;
  const job = await startJob({ kind: 'simulate', asset: open.asset, name: jobName(open.assetName, matter.value), scene: scene() });
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
    const length = secondsOf(edit);
    if (edit.time + step > length && !loop.value) playing.value = false;
    seek(edit, playing.value ? (edit.time + step) % length : length, filmKey);
  }, 1000 / FPS);
  return () => clearInterval(timer);
});

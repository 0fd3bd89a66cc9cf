/** The object as matter: what it is made of, how it falls, and a timeline to play it. Frames are computed as they are first shown. */

import { computed, effect, signal, type Signal } from '@preact/signals';
import { startJob } from '../jobs';
import { pins } from '../pins';
import type { Edit, PoseEdit, SimulateEdit } from '../protocol.gen';
import { editTime, keyOfGesture, newKey, replaceEdits } from '../session';
import { clipSeconds, draft, edits, jobs, pending, session } from '../state';
import { Baking } from './Baking';
import { Choice, Section, Slider, Switch } from './fields';
import { Pins } from './Pins';

const PRESETS = ['jelly', 'rubber', 'clay', 'sand', 'snow', 'honey'] as const;
const preset = signal<(typeof PRESETS)[number]>('jelly');
/** log10 of Young's modulus [kPa]; null: the preset's, which follows the object's size. */
const stiffness = signal<number | null>(null);
/** log10 of t/m³, and Poisson's ratio; null: the preset's. */
const density = signal<number | null>(null);
const poisson = signal<number | null>(null);
/** What the presets say (drgs/deform/simulation_scene.py). A fluid has neither stiffness nor Poisson's ratio. */
const OWN: Record<(typeof PRESETS)[number], { density: number; poisson: number | null }> = {
  jelly: { density: 1, poisson: 0.3 },
  rubber: { density: 1.1, poisson: 0.4 },
  clay: { density: 1.8, poisson: 0.3 },
  sand: { density: 1.6, poisson: 0.2 },
  snow: { density: 0.4, poisson: 0.2 },
  honey: { density: 1.4, poisson: null },
};
const floor = signal(true);
/** Above the floor, in heights of the object. */
const drop = signal(0.5);
const seconds = signal(1.5);
const fine = signal(false);
const playing = signal(false);
const loop = signal(true);
const speed = signal('1');
/** Particles of a quick and a fine simulation. */
const PARTICLES = { quick: 4000, fine: 20_000 };
const FPS = 24;

type Moving = SimulateEdit | PoseEdit;
const moves = (edit: Edit): edit is Moving => edit.op === 'simulate' || edit.op === 'pose';
const running = computed(() => edits.value.findLast(moves) ?? null);
const LONGEST_CLIP = 5;
const durationOf = (edit: Moving) => (edit.op === 'simulate' ? Number(edit.scene.duration ?? 2) : (clipSeconds.value[jobOfClip(edit.clip)] ?? LONGEST_CLIP));
const jobOfClip = (clip: string) => clip.replace(/^clips\//, '');
const clips = computed(() => jobs.value.filter((job) => job.kind === 'simulate' && job.clip !== null && job.source_asset === session.value?.asset));

function sceneOf(height: number, foot: number): Record<string, unknown> {
  const solid = OWN[preset.value].poisson !== null;
  const matter = {
    preset: preset.value,
    ...(solid && stiffness.value !== null && { young_modulus: 1000 * 10 ** stiffness.value }),
    ...(density.value !== null && { density: Number((1000 * 10 ** density.value).toPrecision(4)) }),
    ...(solid && poisson.value !== null && { poisson_ratio: poisson.value }),
  };
  const ground = floor.value ? { height: foot - drop.value * height, friction: 0.5 } : null;
  return { matter, floor: ground, ...(pins.value.length > 0 && { pins: pins.value }), duration: seconds.value, fps: FPS, particles: fine.value ? PARTICLES.fine : PARTICLES.quick };
}

/** One for each film: however slowly it plays, undo takes it away in one step. */
let film = newKey();

/** From the first moment on, in place of whatever moved before. */
function start(edit: Moving): void {
  film = newKey();
  replaceEdits([...edits.value.filter((other) => !moves(other)), edit], film);
  playing.value = true;
}

function stop(): void {
  playing.value = false;
  replaceEdits(edits.value.filter((edit) => !moves(edit)));
}

/** On a worker, so that the picture is not held up; the clip can be played when it is done, and rendered by other jobs. */
async function bake(scene: Record<string, unknown>): Promise<void> {
  const open = session.value!;
  const job = await startJob({ kind: 'simulate', asset: open.asset, name: `${open.assetName}, ${preset.value}`, scene });
  if (job) clipSeconds.value = { ...clipSeconds.value, [job.id]: seconds.value };
}

/** Next frame of the film once the server has taken the last one: it plays as fast as it is computed, never faster than life. */
effect(() => {
  if (!playing.value || !session.value) return;
  let before = performance.now();
  const timer = setInterval(() => {
    const edit = running.value;
    if (!edit || draft.value || pending.value.length > 0) return;
    const now = performance.now();
    const step = Math.min((now - before) / 1000, 2 / FPS) * Number(speed.value);
    before = now;
    const length = durationOf(edit);
    if (edit.time + step > length && !loop.value) playing.value = false;
    seek(edit, playing.value ? (edit.time + step) % length : length, film);
  }, 1000 / FPS);
  return () => clearInterval(timer);
});

function seek(edit: Moving, time: number, key: string): void {
  const next: Edit = { ...edit, time: Math.round(time * 1000) / 1000 };
  editTime(next, key);
}

/** Of a slider whose value is the preset's until it is moved. */
const unlessSet = (value: Signal<number | null>) => ({
  unset: value.value === null,
  onChange: (next: number) => void (value.value = next),
  onReset: value.value === null ? undefined : () => void (value.value = null),
});

export function Simulation({ height, foot }: { height: number; foot: number }) {
  const edit = running.value;
  const own = OWN[preset.value];
  return (
    <Section title="Simulation">
      <Choice bare label="Matter" value={preset.value} options={PRESETS.map((name) => ({ value: name, text: name[0]!.toUpperCase() + name.slice(1) }))} onChange={(next) => (preset.value = next)} />
      {own.poisson !== null && <Slider label="Stiffness" title={stiffness.value === null ? 'Young’s modulus: it follows the object’s size until you set it' : 'Young’s modulus'} unit="kPa" logarithmic value={stiffness.value ?? 2} min={0} max={4} step={0.1} {...unlessSet(stiffness)} />}
      <Slider label="Density" title="Of the matter; water has 1 t/m³" unit="t/m³" logarithmic value={density.value ?? Math.log10(own.density)} min={-2} max={1.3} step={0.05} {...unlessSet(density)} />
      {own.poisson !== null && <Slider label="Poisson" title="Poisson’s ratio: how much it gets thinner when it is drawn out; near 0.5 it keeps its volume" value={poisson.value ?? own.poisson} min={0} max={0.45} step={0.01} {...unlessSet(poisson)} />}
      <Pins />
      <Switch label="Ground" value={floor.value} onChange={(value) => (floor.value = value)} />
      {floor.value && <Slider label="Drop from" unit="×" value={drop.value} min={0} max={2} step={0.05} onChange={(value) => (drop.value = value)} />}
      <Slider label="Length" unit="s" value={seconds.value} min={0.25} max={5} step={0.25} onChange={(value) => (seconds.value = value)} />
      <Switch label="Fine (slow)" value={fine.value} onChange={(value) => (fine.value = value)} />
      <div class="buttons">
        <button class="primary" onClick={() => start({ op: 'simulate', scene: sceneOf(height, foot), time: 0 })}>
          {edit ? 'Start again' : 'Let it go'}
        </button>
        <button title="Compute all of it on a worker first" onClick={() => void bake(sceneOf(height, foot))}>
          Bake as a job
        </button>
        {edit && <button onClick={stop}>Remove</button>}
      </div>
      <Baking />
      {clips.value.length > 0 && (
        <ul class="files" aria-label="Clips">
          {clips.value.map((job) => (
            <li>
              <button aria-pressed={edit?.op === 'pose' && edit.clip === job.clip} onClick={() => start({ op: 'pose', clip: job.clip!, time: 0 })}>
                Play {job.name}
              </button>
            </li>
          ))}
        </ul>
      )}
      {edit && (
        <div class="timeline" role="group" aria-label="Timeline">
          <button onClick={() => (playing.value = !playing.value)}>{playing.value ? 'Pause' : 'Play'}</button>
          <Slider label="Time" unit="s" value={edit.time} min={0} max={durationOf(edit)} step={0.01} onChange={(value) => { playing.value = false; seek(edit, value, keyOfGesture('time')); }} />
          <Choice label="Speed" value={speed.value} options={['0.25', '0.5', '1'].map((value) => ({ value, text: `${value}×` }))} onChange={(value) => (speed.value = value)} />
          <Switch label="Loop" value={loop.value} onChange={(value) => (loop.value = value)} />
        </div>
      )}
      <p class="hint">A moment is computed when it is first shown, so the first round is slow.</p>
    </Section>
  );
}

/**
 * What a simulation of the object begins with: its matter, the ground, what is held, and for how long. It belongs to the session: an edit of its own,
 * which moves nothing, so that changes of it are undone like others and every viewer sees them.
 */

import { computed } from '@preact/signals';
import { withReplaced } from '../../session/edit_list';
import { edits, reviseEdits } from '../../session/edit_log';
import type { Edit } from '../../session/protocol.gen';
import { keyOfGesture } from '../gestures';
import { bounds } from '../mesh';

export const MATTERS = ['jelly', 'rubber', 'clay', 'sand', 'snow', 'honey'] as const;
export type Matter = (typeof MATTERS)[number];
/** Density [t/m³] and Poisson's ratio of each (drgs/deform/matter/simulation_scene.py). A fluid has neither ratio nor stiffness. */
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
export const FPS = 24;
/** Until it is set: over the floor, in heights of the object; and the film's length [s]. */
const DROP_HEIGHT = 0.5;
const SECONDS = 1.5;

/** As drgs/deform/matter/simulation_scene.py has it; what the panel does not show of it stays as it is. */
interface Scene {
  matter: { preset?: string; young_modulus?: number; density?: number; poisson_ratio?: number };
  floor: { height?: number | null; friction?: number } | null;
  pins?: number[];
  duration: number;
  fps: number;
  particles: number;
  [other: string]: unknown;
}

const isMatter = (edit: Edit) => edit.op === 'matter';
const floorAt = (drop: number) => ({ height: bounds.value.minimum[2] - drop * objectHeight(), friction: 0.5 });
const objectHeight = () => Math.max(1e-9, bounds.value.maximum[2] - bounds.value.minimum[2]);

/** As the edits have it. */
export function sceneOf(now: Edit[]): Scene {
  const edit = now.findLast(isMatter);
  const set = edit?.op === 'matter' ? (edit.scene as Partial<Scene>) : {};
  return { matter: { preset: 'jelly' }, floor: floorAt(DROP_HEIGHT), duration: SECONDS, fps: FPS, particles: PARTICLES.quick, ...set };
}

export const scene = computed(() => sceneOf(edits.value));

/** `name`: of what is changed; changes of the same thing without a pause are one step of undo. */
function change(name: string, next: (now: Scene) => Partial<Scene>): void {
  reviseEdits((now) => withReplaced(now, { op: 'matter', scene: { ...sceneOf(now), ...next(sceneOf(now)) } }, isMatter), keyOfGesture(`matter ${name}`));
}

/** Without what is not set. */
const compact = <T extends object>(values: T): T => Object.fromEntries(Object.entries(values).filter(([, value]) => value !== null && value !== undefined)) as T;

export const matter = computed<Matter>(() => MATTERS.find((name) => name === scene.value.matter.preset) ?? 'jelly');
export const matterValues = computed(() => MATTER_VALUES[matter.value]);
/** Another matter has a stiffness, a density and a ratio of its own. */
export const setMatter = (preset: Matter) => change('preset', () => ({ matter: { preset } }));

/** log10 of Young's modulus [kPa]; null: the matter's, which follows the object's size. */
export const stiffness = computed(() => (scene.value.matter.young_modulus === undefined ? null : Math.log10(scene.value.matter.young_modulus / 1000)));
export const setStiffness = (value: number | null) => change('stiffness', (now) => ({ matter: compact({ ...now.matter, young_modulus: value === null ? undefined : 1000 * 10 ** value }) }));
/** log10 of the density [t/m³]; null: the matter's. */
export const density = computed(() => (scene.value.matter.density === undefined ? null : Math.log10(scene.value.matter.density / 1000)));
export const setDensity = (value: number | null) => change('density', (now) => ({ matter: compact({ ...now.matter, density: value === null ? undefined : Number((1000 * 10 ** value).toPrecision(4)) }) }));
/** Poisson's ratio; null: the matter's. */
export const poisson = computed(() => scene.value.matter.poisson_ratio ?? null);
export const setPoisson = (value: number | null) => change('poisson', (now) => ({ matter: compact({ ...now.matter, poisson_ratio: value ?? undefined }) }));

export const hasFloor = computed(() => scene.value.floor !== null);
export const setFloor = (wanted: boolean) => change('floor', () => ({ floor: wanted ? floorAt(DROP_HEIGHT) : null }));
/** Over the floor, in heights of the object. */
export const dropHeight = computed(() => (bounds.value.minimum[2] - (scene.value.floor?.height ?? bounds.value.minimum[2])) / objectHeight());
export const setDropHeight = (drop: number) => change('drop', () => ({ floor: floorAt(drop) }));

/** Length of the film. */
export const seconds = computed(() => scene.value.duration);
export const setSeconds = (duration: number) => change('length', () => ({ duration }));
export const fine = computed(() => scene.value.particles >= PARTICLES.fine);
export const setFine = (wanted: boolean) => change('fine', () => ({ particles: wanted ? PARTICLES.fine : PARTICLES.quick }));

/** Numbers of the vertices that are held. */
export const pins = computed(() => scene.value.pins ?? []);
export const setPins = (vertices: number[]) => change(`pins ${vertices.length}`, () => ({ pins: vertices }));

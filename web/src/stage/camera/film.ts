/** The film of the open asset: the views that its camera passes, kept in this browser, and their preview in the viewport. */

import { computed, signal } from '@preact/signals';
import { preference } from '../../session/preferences';
import { session } from '../../session/session';
import { aimNow, wantedAim, type Aim } from '../../session/view';
import { flying } from '../switches';
import { pathSeconds, viewAt } from './camera_path';

export interface FilmView extends Aim {
  /** Within its film. */
  id: number;
  /** From the view before to this one; to the first one from the last, on a closed path. */
  seconds: number;
}

export const LEAST_SECONDS = 0.1;
export const MOST_SECONDS = 60;
/** To a new view. */
const SECONDS = 2;

/** By asset. */
const films = preference<Record<string, FilmView[]>>('films', {});
export const filmViews = computed<FilmView[]>(() => films.value[session.value?.asset ?? ''] ?? []);
/** By asset: whether its film goes on from the last view to the first. */
const closed = preference<Record<string, boolean>>('closedFilms', {});
export const filmClosed = computed(() => closed.value[session.value?.asset ?? ''] ?? false);
export const filmSeconds = computed(() => pathSeconds(filmViews.value, filmClosed.value));
export const filmPlaying = signal(false);
/** Of the preview [s]. */
export const filmTime = signal(0);

function setViews(views: FilmView[]): void {
  const asset = session.value?.asset;
  if (!asset) return;
  stopFilm();
  const { [asset]: _, ...others } = films.value;
  films.value = views.length ? { ...others, [asset]: views } : others;
  filmTime.value = Math.min(filmTime.value, filmSeconds.value);
}

export function closeFilm(value: boolean): void {
  const asset = session.value?.asset;
  if (!asset) return;
  stopFilm();
  closed.value = { ...closed.value, [asset]: value };
  filmTime.value = Math.min(filmTime.value, filmSeconds.value);
}

/** What is on screen becomes the last view. */
export function addView(): void {
  const aim = aimNow.value;
  if (!aim) return;
  const id = Math.max(0, ...filmViews.value.map((view) => view.id)) + 1;
  setViews([...filmViews.value, { id, ...aim, seconds: SECONDS }]);
}

export const removeView = (id: number) => setViews(filmViews.value.filter((view) => view.id !== id));
export const setViewSeconds = (id: number, seconds: number) => setViews(filmViews.value.map((view) => (view.id === id ? { ...view, seconds } : view)));

/** One place earlier (-1) or later (1); the times between places stay. */
export function moveView(id: number, by: -1 | 1): void {
  const views = filmViews.value;
  const from = views.findIndex((view) => view.id === id);
  const to = from + by;
  if (from < 0 || to < 0 || to >= views.length) return;
  const moved = views.with(from, views[to]!).with(to, views[from]!);
  setViews(moved.map((view, k) => ({ ...view, seconds: views[k]!.seconds })));
}

export function showView({ eye, target, fov_y_degrees }: Aim): void {
  stopFilm();
  flying.value = false;
  wantedAim.value = { eye, target, fov_y_degrees, smooth: true };
}

export function seekFilm(time: number): void {
  filmTime.value = Math.min(Math.max(time, 0), filmSeconds.value);
  if (filmViews.value.length === 0) return;
  flying.value = false;
  wantedAim.value = { ...viewAt(filmViews.value, filmTime.value, filmClosed.value), smooth: false };
}

/** From where the preview is; from the start once it has come to the end, where a closed one goes on. */
export function playFilm(): void {
  if (filmViews.value.length < 2 || filmPlaying.value) return;
  filmPlaying.value = true;
  interrupts = new AbortController();
  for (const kind of ['pointerdown', 'wheel']) window.addEventListener(kind, stopOnStage, { capture: true, passive: true, signal: interrupts.signal });
  seekFilm(filmTime.value >= filmSeconds.value ? 0 : filmTime.value);
  const asset = session.value?.asset;
  let before = performance.now();
  const step = (now: number) => {
    if (!filmPlaying.value) return;
    if (session.value?.asset !== asset) return stopFilm();
    const time = filmTime.value + Math.max(0, now - before) / 1000;
    seekFilm(filmClosed.value ? time % filmSeconds.value : time);
    before = now;
    if (filmTime.value >= filmSeconds.value) stopFilm();
    else requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
}

export function stopFilm(): void {
  filmPlaying.value = false;
  interrupts.abort();
}

let interrupts = new AbortController();

/** A hand on the camera ends the preview. */
const stopOnStage = (event: Event) => event.target instanceof Element && event.target.closest('.stage') && stopFilm();

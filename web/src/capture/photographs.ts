/** What the picture is compared with: the capture's photographs, from their own cameras, and the object as captured. */

import { batch, computed, effect, signal } from '@preact/signals';
import * as api from '../session/api';
import { attempt } from '../session/notices';
import type { TrainingView, TrainingViewList } from '../session/protocol.gen';
import { session } from '../session/session';
import { viewNow, type Row } from '../session/view';

/** The capture's views of the open asset; null until they are known. */
export const trainingViews = signal<TrainingViewList | null>(null);
/** Number of the view that is looked through. */
export const viewNumber = signal<number | null>(null);
export const viewInSight = computed<TrainingView | null>(() => (viewNumber.value === null ? null : (trainingViews.value?.views[viewNumber.value] ?? null)));
/** Of the photograph over the picture [%]. */
export const photographOpacity = signal(50);
/** Where the window is split between before (left) and now, as a share of its width; null: it is not. */
export const split = signal<number | null>(null);
/** Whether a photograph can be shown: it then stands left of the split, in place of the object as captured. */
export const photographInSight = computed(() => viewInSight.value !== null && (trainingViews.value?.has_photographs ?? false));

export interface Place {
  left: number;
  top: number;
  width: number;
  height: number;
}
/** Of the photograph in the window [CSS pixels]; null while the camera is on its way to it. */
export const photographPlace = signal<Place | null>(null);

let asked: string | null = null;
effect(() => {
  const asset = session.value?.asset ?? null;
  if (asset === asked) return;
  asked = asset;
  batch(() => {
    trainingViews.value = viewNumber.value = photographPlace.value = split.value = null;
  });
  if (asset === null) return;
  void attempt(api.listTrainingViews(asset)).then((found) => {
    if (found && asked === asset) trainingViews.value = found;
  });
});

/** To the next view, or the one before, round the end; does nothing while none is looked through. */
export function stepView(by: 1 | -1): void {
  const count = trainingViews.value?.views.length ?? 0;
  if (viewNumber.value !== null && count > 0) viewNumber.value = (viewNumber.value + by + count) % count;
}

/** Look through the view that is nearest to the present camera, or through none. */
export function showPhotographs(on: boolean): void {
  const views = trainingViews.value?.views ?? [];
  viewNumber.value = on && views.length > 0 ? nearestView(views, viewNow.value?.world_from_camera ?? views[0]!.world_from_camera) : null;
}

/** Number of the view that looks most nearly in the direction of `camera`, a world-from-camera matrix. */
export function nearestView(views: TrainingView[], camera: readonly Row[] | TrainingView['world_from_camera']): number {
  const backward = (rows: readonly (readonly number[])[]) => [rows[0]![2]!, rows[1]![2]!, rows[2]![2]!];
  const from = backward(camera);
  const agreement = views.map((view) => backward(view.world_from_camera).reduce((sum, value, i) => sum + value * from[i]!, 0));
  return agreement.indexOf(Math.max(...agreement));
}

/** Of a picture on the plane at distance 1 of its camera, or of the window's free part [CSS pixels]. */
export interface Edges {
  left: number;
  right: number;
  top: number;
  bottom: number;
}

/** Panels may cover the window's middle: each side of a photograph still gets this share of the way from there to the window's edge. */
const LEAST_ROOM = 0.15;

/**
 * The vertical field of view with which a window shows all of a view's picture in its free part, and where the picture then lies.
 *
 * The window's middle is the camera's axis, so the nearest free edge limits the picture's size.
 */
export function placeView(view: Edges, window: { width: number; height: number }, free: Edges): { fovDegrees: number; place: Place } {
  const across = window.width / 2;
  const down = window.height / 2;
  const sides = [
    { extent: -view.left, room: across - free.left, half: across },
    { extent: view.right, room: free.right - across, half: across },
    { extent: view.top, room: down - free.top, half: down },
    { extent: -view.bottom, room: free.bottom - down, half: down },
  ];
  const fits = sides.filter(({ extent }) => extent > 0).map(({ extent, room, half }) => Math.max(room, LEAST_ROOM * half) / extent);
  const pixels = Math.min(...fits); // of what is 1 wide at distance 1
  return {
    fovDegrees: (360 / Math.PI) * Math.atan(down / pixels),
    place: { left: across + view.left * pixels, top: down - view.top * pixels, width: (view.right - view.left) * pixels, height: (view.top - view.bottom) * pixels },
  };
}

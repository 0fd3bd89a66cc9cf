/** How the page is laid out: theme, open panels, the inspector's tab. */

import { computed, effect, signal } from '@preact/signals';
import { viewNumber } from '../capture/photographs';
import { shapeToolsShown } from '../edit/shape/shape_tools';
import { preference } from '../session/preferences';
import { openedAsset } from '../session/session';

export const theme = preference<'dark' | 'light'>('theme', matchMedia('(prefers-color-scheme: light)').matches ? 'light' : 'dark');
export const libraryOpen = preference<boolean>('libraryOpen', true);
export const inspectorOpen = preference<boolean>('inspectorOpen', true);
export const helpOpen = signal(false);

/** A phone, whose panels lie over the lower half of the picture, one at a time. */
const phone = matchMedia('(max-width: 620px)');
export const onPhone = signal(phone.matches);
phone.addEventListener('change', () => (onPhone.value = phone.matches));

/** On a phone, leave the whole page to the picture; the buttons above it bring the panels back. */
export function foldPanels(): void {
  if (onPhone.peek()) libraryOpen.value = inspectorOpen.value = false;
}
effect(() => {
  if (openedAsset.value !== null) foldPanels();
});

/** Whether the camera is held at a view of the capture, whose middle is the window's: on a phone panels would lie over its photograph. */
export const atView = computed(() => viewNumber.value !== null);
effect(() => {
  if (atView.value) foldPanels();
});

/** Whether it is in sight: on a phone the library stands in its place. */
export const inspectorShown = computed(() => inspectorOpen.value && !(onPhone.value && libraryOpen.value));
export function toggleInspector(): void {
  const shown = inspectorShown.value;
  if (onPhone.value) libraryOpen.value = false;
  inspectorOpen.value = !shown;
}

export const lightsOpen = signal(false);

export type Tab = 'material' | 'light' | 'shape' | 'view' | 'out';
export const tab = preference<Tab>('tab', 'material');
effect(() => void (shapeToolsShown.value = tab.value === 'shape'));

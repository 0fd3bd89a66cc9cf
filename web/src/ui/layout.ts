/** How the page is laid out: theme, open panels, the inspector's tab. */

import { effect, signal } from '@preact/signals';
import { shapeToolsShown } from '../edit/shape/shape_tools';
import { preference } from '../session/preferences';

export const theme = preference<'dark' | 'light'>('theme', matchMedia('(prefers-color-scheme: light)').matches ? 'light' : 'dark');
export const libraryOpen = preference<boolean>('libraryOpen', true);
export const inspectorOpen = preference<boolean>('inspectorOpen', true);
export const helpOpen = signal(false);
export const lightsOpen = signal(false);

export type Tab = 'material' | 'light' | 'shape' | 'view' | 'out';
export const tab = preference<Tab>('tab', 'material');
effect(() => void (shapeToolsShown.value = tab.value === 'shape'));

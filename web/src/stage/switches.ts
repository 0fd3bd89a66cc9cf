/** What of the picture is switched on: shared by keys, panels and the viewport. */

import { signal } from '@preact/signals';
import { preference } from '../session/preferences';

/** While true the local picture shows material and shape as captured. */
export const before = signal(false);
/** The camera flies; else it orbits. */
export const flying = signal(false);
/** The mesh's edges over whatever channel is shown. */
export const wireframe = signal(false);
/** Draw the mesh locally until the traced frame arrives. */
export const localPicture = preference<boolean>('localPicture', true);
/** How many pixels the still picture may have. */
export const resolution = preference<'low' | 'medium' | 'full'>('resolution', 'medium');

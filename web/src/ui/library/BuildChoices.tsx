/** How a capture becomes an asset, as a user chooses it. */

import { signal } from '@preact/signals';
import type { BuildChoice } from '../../session/jobs';
import { Choice } from '../fields';

export const build = signal<BuildChoice>({ preset: 'fast', binding: 'particles', light: 'auto', masks: 'auto', cameras: 'auto' });

export function BuildChoices() {
  return (
    <>
      <Choice
        label="Quality"
        value={build.value.preset}
        options={[
          { value: 'draft', text: 'Draft', title: 'About a minute: to see whether the capture works' },
          { value: 'fast', text: 'Fast', title: 'Some minutes' },
          { value: 'full', text: 'Full', title: 'Up to an hour: the best this capture gives' },
        ]}
        onChange={(preset) => (build.value = { ...build.value, preset })}
      />
      <details class="fold">
        <summary>Advanced</summary>
        <Choice
          label="Gaussians lie"
          value={build.value.binding}
          options={[
            { value: 'particles', text: 'As fitted', title: 'Where they were fitted, carried along by the mesh: the sharper pictures' },
            { value: 'mesh', text: 'On the mesh', title: 'Rebuilt on its faces, one a face: they follow every deformation exactly, highlights are a little softer' },
          ]}
          onChange={(binding) => (build.value = { ...build.value, binding })}
        />
        <Choice
          label="Lamps stood still with"
          value={build.value.light}
          options={[
            { value: 'auto', text: 'Auto', title: 'By what is around the object in the pictures, and by how its brightness changes' },
            { value: 'object', text: 'The object', title: 'The camera went around it' },
            { value: 'camera', text: 'The camera', title: 'The object stood on a turntable' },
          ]}
          onChange={(light) => (build.value = { ...build.value, light })}
        />
        <Choice
          label="Masks end"
          value={build.value.masks}
          options={[
            { value: 'auto', text: 'At edges', title: 'Where the pictures show the object to end, if the masks are a pixel or two off' },
            { value: 'given', text: 'As given', title: 'Where the capture has them' },
          ]}
          onChange={(masks) => (build.value = { ...build.value, masks })}
        />
        <Choice
          label="Cameras stand"
          value={build.value.cameras}
          options={[
            { value: 'auto', text: 'As they fit', title: 'Moved by parts of a pixel while the object is fitted, if they are off' },
            { value: 'given', text: 'As given', title: 'Where the capture has them' },
          ]}
          onChange={(cameras) => (build.value = { ...build.value, cameras })}
        />
      </details>
    </>
  );
}

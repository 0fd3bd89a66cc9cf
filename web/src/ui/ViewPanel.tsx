/** What the picture shows, and how well. */

import type { Settings } from '../protocol.gen';
import { changeSettings } from '../session';
import { titleFor } from '../shortcuts';
import { flying, localPicture, resolution, settings, status } from '../state';
import { CompareSection } from './Compare';
import { Choice, Section, Switch } from './fields';

export const CHANNELS: { value: NonNullable<Settings['channel']>; text: string }[] = [
  { value: 'final', text: 'Final' },
  { value: 'albedo', text: 'Albedo' },
  { value: 'roughness', text: 'Rough' },
  { value: 'metallic', text: 'Metal' },
  { value: 'normal', text: 'Normal' },
  { value: 'depth', text: 'Depth' },
];

export function ViewPanel() {
  const { channel, spp_target, bounces, denoise } = settings.value;
  const notes = status.value?.notes ?? [];
  return (
    <>
      <Section title="Channel">
        <Choice bare label="Show" value={channel} options={CHANNELS} onChange={(value) => changeSettings({ channel: value })} />
      </Section>
      <Section title="Quality">
        <Choice
          label="Resolution at rest"
          value={resolution.value}
          options={[
            { value: 'low', text: 'Low', title: 'At most 0.2 megapixels' },
            { value: 'medium', text: 'Medium', title: 'At most 0.5 megapixels' },
            { value: 'full', text: 'Full', title: 'Every pixel of the window, up to 4 megapixels' },
          ]}
          onChange={(value) => (resolution.value = value)}
        />
        <Choice
          label="Samples a pixel"
          value={String(spp_target)}
          options={['64', '256', '1024'].map((value) => ({ value, text: value }))}
          onChange={(value) => changeSettings({ spp_target: Number(value) })}
        />
        <Choice label="Indirect bounces" value={String(bounces)} options={['0', '1', '2', '4'].map((value) => ({ value, text: value }))} onChange={(value) => changeSettings({ bounces: Number(value) })} />
        <Switch label="Denoise" title="Filter what is left of the noise; fades as samples add up" value={denoise} onChange={(value) => changeSettings({ denoise: value })} />
        <Switch label="Instant local picture" title={titleFor('local', 'Draw the mesh in the browser while the traced picture is on its way')} value={localPicture.value} onChange={(value) => (localPicture.value = value)} />
      </Section>
      <CompareSection />
      <Section title="Camera">
        <Switch label="Fly with W A S D Q E" title={titleFor('fly')} value={flying.value} onChange={(value) => (flying.value = value)} />
      </Section>
      {notes.length > 0 && (
        <Section title="What was left out">
          <ul class="notes">
            {notes.map((note) => (
              <li>{note}</li>
            ))}
          </ul>
        </Section>
      )}
    </>
  );
}

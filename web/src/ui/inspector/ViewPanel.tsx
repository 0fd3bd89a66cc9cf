/** What the picture shows, and how well. */

import { STILL_BOUNCES } from '../../session/constants.gen';
import { assets } from '../../session/library';
import { NO_CERTAINTY } from '../../session/protocol.gen';
import { changeSettings, session, settings, status } from '../../session/session';
import { CHANNELS, entryOf } from '../../stage/channels';
import { shapeIsKnown } from '../../stage/shape_now';
import { flying, localPicture, resolution, wireframe } from '../../stage/switches';
import { CompareSection } from '../Compare';
import { Choice, Section, Switch } from '../fields';
import { titleFor, type ActionName } from '../shortcuts';

const sentenceOf = (note: string) => `${note.charAt(0).toUpperCase()}${note.slice(1)}.`;

function Legend() {
  const { channel } = settings.value;
  const { legend, scale } = entryOf(channel);
  const meshOnly = assets.value?.find(({ id }) => id === session.value?.asset)?.surfel_count === 0;
  if (channel === 'surfels' && meshOnly) return <p class="hint">This asset was made from a mesh: it has no surfels to show.</p>;
  if (channel === 'certainty' && status.value?.notes.includes(NO_CERTAINTY)) return <p class="hint">{sentenceOf(NO_CERTAINTY)}</p>;
  if (!legend) return null;
  return (
    <div class="legend">
      {scale && (
        <>
          <div class={`scale ${scale.kind}`} aria-hidden="true" />
          <div class="marks" aria-hidden="true">
            {scale.marks.map((mark) => (
              <span>{mark}</span>
            ))}
          </div>
        </>
      )}
      <p class="hint">{legend}</p>
    </div>
  );
}

export function ViewPanel() {
  const { channel, spp_target, bounces, denoise } = settings.value;
  const notes = status.value?.notes ?? [];
  return (
    <>
      <Section title="Channel">
        <Choice
          bare
          columns={4}
          label="Show"
          value={channel}
          options={CHANNELS.map(({ value, text, title }, i) => ({ value, text, title: titleFor(`channel${i + 1}` as ActionName, title) }))}
          onChange={(value) => changeSettings({ channel: value })}
        />
        <Legend />
        <Switch label="Edges of the mesh" title={titleFor('wireframe', 'Drawn over the picture by the browser')} value={wireframe.value} onChange={(value) => (wireframe.value = value)} />
        {wireframe.value && !shapeIsKnown.value && <p class="hint">The browser does not know the shape while it plays, or without the local picture: its edges are not shown.</p>}
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
          options={['16', '64', '256', '1024'].map((value) => ({ value, text: value }))}
          onChange={(value) => changeSettings({ spp_target: Number(value) })}
        />
        <Choice label="Indirect bounces" value={String(bounces)} options={['0', '1', '2', '4'].map((value) => ({ value, text: value, title: value === '1' ? `Of moving pictures; saved ones and films then have ${STILL_BOUNCES}` : undefined }))} onChange={(value) => changeSettings({ bounces: Number(value) })} />
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

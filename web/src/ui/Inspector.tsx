/** Right-hand panel: material, light, view, history and export of the open asset. */

import { useRef } from 'preact/hooks';
import * as api from '../api';
import { type Triple } from '../color';
import { describeEdit } from '../edit_log';
import { takeFile } from '../jobs';
import type { Settings } from '../protocol.gen';
import { changeSettings, editLight, editMaterial, redo, undoTo } from '../session';
import { titleFor } from '../shortcuts';
import { captured, environments, inspectorOpen, light, localPicture, log, material, notify, resolution, session, settings } from '../state';
import { Choice, ColorField, Section, Slider, Switch } from './fields';
import { Icon } from './icons';

export function Inspector({ onStill }: { onStill(): void }) {
  if (!session.value || !inspectorOpen.value) return null;
  return (
    <aside class="panel inspector" aria-label="Inspector">
      <Material />
      <Light />
      <View />
      <History />
      <Export onStill={onStill} />
    </aside>
  );
}

const NEUTRAL = { albedo: [0.5, 0.5, 0.5] as Triple, roughness: 0.5, metallic: 0 };

function Material() {
  const mean = captured.value ?? NEUTRAL;
  const { albedo, roughness, metallic } = material.value;
  const at = (part: { value: number | null; factor: number }, captured: number) => Math.min(1, (part.value ?? captured) * part.factor);
  const color = (albedo.value ?? mean.albedo).map((value, i) => Math.min(1, value * albedo.factor[i]!)) as Triple;
  return (
    <Section title="Material">
      <p class="hint">Applies to the whole object. A dimmed value is the captured average.</p>
      <ColorField label="Colour" value={color} unset={albedo.value === null} onChange={(value) => editMaterial({ albedo: value })} onReset={albedo.value ? () => editMaterial({ albedo: mean.albedo }) : undefined} />
      <Slider
        label="Roughness"
        value={at(roughness, mean.roughness)}
        min={0}
        max={1}
        step={0.01}
        unset={roughness.value === null}
        onChange={(value) => editMaterial({ roughness: value })}
        onReset={roughness.value === null ? undefined : () => editMaterial({ roughness: mean.roughness })}
      />
      <Slider
        label="Metallic"
        value={at(metallic, mean.metallic)}
        min={0}
        max={1}
        step={0.01}
        unset={metallic.value === null}
        onChange={(value) => editMaterial({ metallic: value })}
        onReset={metallic.value === null ? undefined : () => editMaterial({ metallic: mean.metallic })}
      />
    </Section>
  );
}

function Light() {
  const file = useRef<HTMLInputElement>(null);
  const { rotation, intensity, file: current } = light.value;
  const stops = settings.value.exposure_stops;
  return (
    <Section title="Light">
      <div class="gallery" role="radiogroup" aria-label="Environment">
        {environments.value.map((environment) => (
          <label class="tile" title={environment.title}>
            <input type="radio" name="environment" checked={current === environment.name} onChange={() => editLight({ file: environment.name })} />
            <img src={api.environmentThumb(environment.name)} alt="" loading="lazy" />
            <span>{environment.title}</span>
          </label>
        ))}
        <button class="tile add" title="Add an EXR or HDR; or drop one on the page" onClick={() => file.current?.click()}>
          <Icon name="plus" />
          <span>Add…</span>
        </button>
        <input
          ref={file}
          class="visually-hidden"
          type="file"
          accept=".exr,.hdr"
          tabIndex={-1}
          aria-label="Environment file"
          onChange={(event) => {
            const chosen = event.currentTarget.files?.[0];
            event.currentTarget.value = '';
            if (chosen) void takeFile(chosen, 'fast', () => {});
          }}
        />
      </div>
      <Slider label="Rotation" unit="°" value={rotation} min={0} max={360} step={1} onChange={(value) => editLight({ rotation: value })} onReset={rotation ? () => editLight({ rotation: 0 }) : undefined} />
      <Slider label="Intensity" unit="×" value={intensity} min={0} max={4} step={0.01} onChange={(value) => editLight({ intensity: value })} onReset={intensity !== 1 ? () => editLight({ intensity: 1 }) : undefined} />
      <Slider label="Exposure" unit="EV" value={stops} min={-4} max={4} step={0.05} onChange={(value) => changeSettings({ exposure_stops: value })} onReset={stops ? () => changeSettings({ exposure_stops: 0 }) : undefined} />
      <Background />
    </Section>
  );
}

const GREY: Triple = [0.5, 0.5, 0.5];
const srgbHex = (color: Triple) => `#${color.map((c) => Math.round(255 * c).toString(16).padStart(2, '0')).join('')}`;
const srgbOf = (hex: string) => [1, 3, 5].map((start) => parseInt(hex.slice(start, start + 2), 16) / 255) as Triple;

function Background() {
  const { background } = settings.value;
  const kind = Array.isArray(background) ? 'colour' : background;
  const hex = srgbHex(Array.isArray(background) ? background : GREY);
  return (
    <div class="row">
      <Choice
        label="Background"
        value={kind}
        options={[
          { value: 'environment', text: 'Light', title: 'Show the environment behind the object' },
          { value: 'colour', text: 'Colour' },
          { value: 'transparent', text: 'None', title: 'Transparent in the saved PNG' },
        ]}
        onChange={(value) => changeSettings({ background: value === 'colour' ? GREY : value })}
      />
      {kind === 'colour' && <input type="color" aria-label="Background colour" value={hex} onInput={(event) => changeSettings({ background: srgbOf(event.currentTarget.value) })} />}
    </div>
  );
}

const CHANNELS: { value: NonNullable<Settings['channel']>; text: string }[] = [
  { value: 'final', text: 'Final' },
  { value: 'albedo', text: 'Albedo' },
  { value: 'roughness', text: 'Rough' },
  { value: 'metallic', text: 'Metal' },
  { value: 'normal', text: 'Normal' },
  { value: 'depth', text: 'Depth' },
];

function View() {
  const { channel, spp_target, bounces, denoise } = settings.value;
  return (
    <Section title="View">
      <Choice label="Channel" value={channel} options={CHANNELS} onChange={(value) => changeSettings({ channel: value })} />
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
  );
}

function History() {
  const { edits, can_redo } = log.value;
  return (
    <Section title="History">
      <ol class="history" aria-label="Edits in force">
        <li>
          <button disabled={edits.length === 0} onClick={() => undoTo(0)}>
            As captured
          </button>
        </li>
        {edits.map((edit, i) => (
          <li key={i}>
            <button aria-current={i === edits.length - 1 ? 'step' : undefined} title="Undo everything after this" onClick={() => undoTo(i + 1)}>
              {describeEdit(edit)}
            </button>
          </li>
        ))}
        {can_redo && (
          <li>
            <button class="undone" title={titleFor('redo')} onClick={redo}>
              Redo the undone edit
            </button>
          </li>
        )}
      </ol>
    </Section>
  );
}

function Export({ onStill }: { onStill(): void }) {
  const open = session.value!;
  const link = (format: api.ExportFormat, text: string, title: string) => (
    <a class="button" href={api.assetExport(open.asset, format)} download title={title}>
      <Icon name="download" /> {text}
    </a>
  );
  const copy = async () => {
    const body = JSON.stringify(log.value.edits, null, 1);
    try {
      await navigator.clipboard.writeText(body);
      notify('The edits are on the clipboard, as `drgs render --edits` reads them.', 'info');
    } catch {
      notify('The browser did not allow writing to the clipboard.');
    }
  };
  return (
    <Section title="Export">
      <div class="buttons">
        <button title={titleFor('still')} onClick={onStill}>
          <Icon name="camera" /> Picture (PNG)
        </button>
        {link('glb', 'Mesh (GLB)', 'Mesh with metallic-roughness textures')}
        {link('ply', 'Gaussians (PLY)', '2D Gaussians with the field names of 2DGS')}
        {link('env', 'Light (EXR)', 'The recovered environment')}
        <button onClick={copy}>Copy edits (JSON)</button>
      </div>
    </Section>
  );
}

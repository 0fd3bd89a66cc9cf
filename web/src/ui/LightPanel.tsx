/** Where the light comes from, how strong it is, and what stands behind the object. */

import { useRef } from 'preact/hooks';
import * as api from '../api';
import { type Triple } from '../color';
import { takeFile } from '../jobs';
import { changeSettings, editLight, useCapturedLight } from '../session';
import { capturedLight, environments, light, settings } from '../state';
import { Choice, Section, Slider } from './fields';
import { Icon } from './icons';

export function LightPanel() {
  return (
    <>
      <Environment />
      <Background />
    </>
  );
}

function Environment() {
  const file = useRef<HTMLInputElement>(null);
  const { rotation, intensity, file: current } = light.value;
  const stops = settings.value.exposure_stops;
  const tile = (name: string | null, title: string, picture: string | null, choose: () => void) => (
    <label class="tile" title={title}>
      <input type="radio" name="environment" checked={current === name} onChange={choose} />
      {picture ? <img src={picture} alt="" loading="lazy" /> : <span class="no-light" aria-hidden="true" />}
      <span>{title}</span>
    </label>
  );
  return (
    <Section title="Light">
      <div class="gallery" role="radiogroup" aria-label="Environment">
        {tile(null, 'Captured', capturedLight.value, useCapturedLight)}
        {environments.value.map((environment) => tile(environment.name, environment.title, api.environmentThumb(environment.name), () => editLight({ file: environment.name })))}
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
      <p class="hint">Alt+drag on the picture turns the light. Exposure is the camera’s: it is yours alone and no edit.</p>
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
    <Section title="Background">
      <div class="row">
        <Choice
          bare
          label="Behind the object"
          value={kind}
          options={[
            { value: 'environment', text: 'Light', title: 'Show the environment' },
            { value: 'colour', text: 'Colour' },
            { value: 'transparent', text: 'None', title: 'Transparent in a saved PNG' },
          ]}
          onChange={(value) => changeSettings({ background: value === 'colour' ? GREY : value })}
        />
        {kind === 'colour' && <input type="color" aria-label="Background colour" value={hex} onInput={(event) => changeSettings({ background: srgbOf(event.currentTarget.value) })} />}
      </div>
    </Section>
  );
}

/** Where the light comes from, how strong it is, and what stands behind the object. */

import { useRef } from 'preact/hooks';
import type { Rgb } from '../../edit/material/color';
import * as api from '../../session/api';
import { takeFile } from '../../capture/take_file';
import { capturedEnvironmentThumbnail, editLight, light, restoreCapturedLight } from '../../edit/light';
import { elevationOf, HIGHEST_SUN, LOWEST_SUN, SUN_AND_SKY, sunAndSky, USUAL_SUN } from '../../edit/sun_and_sky';
import { environments } from '../../session/library';
import { changeSettings, lightCamera, settings } from '../../session/session';
import { Choice, Section, Slider, Switch } from '../fields';
import { Icon } from '../icons';
import { lightsOpen } from '../layout';

export function LightPanel() {
  return (
    <>
      <Environment />
      <Picture />
      <Background />
    </>
  );
}

function Environment() {
  const file = useRef<HTMLInputElement>(null);
  const { rotation, intensity, file: current } = light.value;
  const elevation = elevationOf(current);
  const wantedElevation = useRef(USUAL_SUN);
  const tile = (name: string | null, title: string, picture: string | null, choose: () => void) => (
    <label class="tile" title={title}>
      <input type="radio" name="environment" checked={current === name || (name === SUN_AND_SKY && elevation !== null)} onChange={choose} />
      {picture ? <img src={picture} alt="" loading="lazy" /> : <span class="no-light" aria-hidden="true" />}
      <span>{title}</span>
    </label>
  );
  return (
    <Section title="Light">
      <div class="gallery" role="radiogroup" aria-label="Environment">
        {tile(null, 'Captured', capturedEnvironmentThumbnail.value, restoreCapturedLight)}
        {environments.value.map((environment) => tile(environment.name, environment.title, api.environmentThumb(environment.name === SUN_AND_SKY && elevation !== null ? current! : environment.name), () => editLight({ file: environment.name })))}
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
            if (chosen) void takeFile(chosen, () => {}, new AbortController().signal);
          }}
        />
      </div>
      {current === null && lightCamera.value && (
        <>
          <Switch
            label="Turns with the camera"
            title="As while the photographs were taken; off, it stays where the first of them had it"
            value={settings.value.turn_light}
            onChange={(value) => changeSettings({ turn_light: value })}
          />
          <p class="hint">These photographs were taken under light that stood still with the camera, as on a turntable. Other lights stand still with the object.</p>
        </>
      )}
      {elevation !== null && (
        <Slider
          label="Elevation"
          unit="°"
          value={elevation}
          min={LOWEST_SUN}
          max={HIGHEST_SUN}
          step={1}
          onChange={(value) => (wantedElevation.current = Math.round(value))}
          onCommit={() => editLight({ file: sunAndSky(wantedElevation.current) })}
          onReset={elevation !== USUAL_SUN ? () => editLight({ file: SUN_AND_SKY }) : undefined}
        />
      )}
      <Slider label="Rotation" unit="°" value={rotation} min={0} max={360} step={1} onChange={(value) => editLight({ rotation: value })} onReset={rotation ? () => editLight({ rotation: 0 }) : undefined} />
      <Slider label="Intensity" unit="×" value={intensity} min={0} max={4} step={0.01} onChange={(value) => editLight({ intensity: value })} onReset={intensity !== 1 ? () => editLight({ intensity: 1 }) : undefined} />
      <p class="hint">{elevation !== null && 'Elevation is how high the sun stands. '}Alt+drag on the picture turns the light.</p>
      <div class="buttons">
        <button title="Four of them beside each other" onClick={() => (lightsOpen.value = true)}>
          Compare lights
        </button>
      </div>
    </Section>
  );
}

function Picture() {
  const { exposure_stops: stops, tone_curve: curve } = settings.value;
  return (
    <Section title="Exposure and tone">
      <Slider label="Exposure" unit="EV" value={stops} min={-4} max={4} step={0.05} onChange={(value) => changeSettings({ exposure_stops: value })} onReset={stops ? () => changeSettings({ exposure_stops: 0 }) : undefined} />
      <Choice
        label="Tone curve"
        value={curve}
        options={[
          { value: 'standard', text: 'Standard', title: 'None: colours as they are, and what is brighter than white clips' },
          { value: 'neutral', text: 'Neutral', title: 'Khronos PBR Neutral: base colours as they are, highlights compressed' },
          { value: 'filmic', text: 'Filmic', title: 'ACES: contrasty, highlights roll off softly' },
          { value: 'agx', text: 'AgX', title: 'Low contrast, bright colours fade to white' },
        ]}
        onChange={(value) => changeSettings({ tone_curve: value })}
      />
      <p class="hint">These are the camera’s: yours alone, and no edits. EXR files stay linear.</p>
    </Section>
  );
}

const GREY: Rgb = [0.5, 0.5, 0.5];
const srgbHex = (color: Rgb) => `#${color.map((c) => Math.round(255 * c).toString(16).padStart(2, '0')).join('')}`;
const srgbOf = (hex: string) => [1, 3, 5].map((start) => parseInt(hex.slice(start, start + 2), 16) / 255) as Rgb;

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
            { value: 'blurred', text: 'Blurred', title: 'Show the environment out of focus; its light stays sharp' },
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

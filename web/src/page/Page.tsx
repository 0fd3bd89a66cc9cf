/** The page round the picture: its title, and a panel for light, material and view. */

import { useSignalEffect } from '@preact/signals';
import { useEffect, useMemo, useRef, useState } from 'preact/hooks';
import { hexFromLinear, linearFromHex } from '../edit/material/color';
import { PRESETS } from '../edit/material/preset_table';
import { Section, Slider, Switch } from '../ui/fields';
import { Icon } from '../ui/icons';
import { chosenLight, choosePreset, chooseWorn, exposureStops, metallic, panelOpen, preset, rotation, roughness, sky, tint, turning, material, WHITE, worn } from './choices';
import type { PageObject } from './page_object';
import { PageStage } from './page_stage';
import { skyThumbnail } from './sky_thumbnail';

const NARROW = '(max-width: 620px)';
/** What a slider stands at while the object has values of its own. */
const MIDDLE = 0.5;

export function Page({ object }: { object: PageObject }) {
  const stage = useRef<HTMLDivElement>(null);
  const canvas = useRef<HTMLCanvasElement>(null);
  const shown = useRef<PageStage | null>(null);
  const [trouble, setTrouble] = useState('');

  useEffect(() => {
    panelOpen.value = !matchMedia(NARROW).matches;
    try {
      shown.current = new PageStage(stage.current!, canvas.current!, object, matchMedia('(prefers-reduced-motion: reduce)').matches);
    } catch (error) {
      setTrouble((error as Error).message);
    }
  }, []);

  return (
    <>
      <div
        ref={stage}
        class="stage"
        tabIndex={0}
        role="application"
        aria-label={`Picture of ${object.title}. Arrow keys go round it, plus and minus change the distance, F frames it, the space bar lets it turn.`}
      >
        <canvas ref={canvas} aria-hidden="true" />
      </div>
      <header class="topbar">
        <h1>{object.title}</h1>
        <span class="spacer" />
        <Toggle name="Turn by itself" icon={turning.value ? 'stop' : 'play'} value={turning.value} onChange={(value) => (turning.value = value)} />
        <button class="ghost" title="Frame the object (F)" aria-label="Frame the object" onClick={() => shown.current?.frame()}>
          <Icon name="frame" />
        </button>
        <Toggle name="Light and material" icon="inspector" value={panelOpen.value} onChange={(value) => (panelOpen.value = value)} />
      </header>
      {trouble && (
        <div class="welcome" role="alert">
          <h2>No picture</h2>
          <p>{trouble}</p>
        </div>
      )}
      {panelOpen.value && (
        <aside class="panel inspector" aria-label="Light and material">
          <div class="tab-page">
            <LightSection object={object} />
            <MaterialSection object={object} />
            <About object={object} />
          </div>
        </aside>
      )}
    </>
  );
}

function Toggle({ name, icon, value, onChange }: { name: string; icon: Parameters<typeof Icon>[0]['name']; value: boolean; onChange(value: boolean): void }) {
  return (
    <button class="ghost" title={name} aria-label={name} aria-pressed={value} onClick={() => onChange(!value)}>
      <Icon name={icon} />
    </button>
  );
}

function LightSection({ object }: { object: PageObject }) {
  const pictures = useMemo(() => object.lights.map(({ tables }) => skyThumbnail(tables[1]!)), [object]);
  return (
    <Section title="Light">
      <div class="gallery lights" role="radiogroup" aria-label="Light">
        {object.lights.map(({ name }, k) => (
          <label class="tile" title={name}>
            <input type="radio" name="light" checked={chosenLight.value === k} onChange={() => (chosenLight.value = k)} />
            <img src={pictures[k]} alt="" />
            <span>{name}</span>
          </label>
        ))}
      </div>
      <Slider
        label="Turn"
        title="Of the light; on the picture: drag with Alt"
        unit="°"
        value={rotation.value}
        min={-180}
        max={180}
        step={1}
        onChange={(value) => (rotation.value = value)}
        onReset={rotation.value === 0 ? undefined : () => (rotation.value = 0)}
      />
      <Slider
        label="Exposure"
        unit="EV"
        value={exposureStops.value}
        min={-4}
        max={4}
        step={0.1}
        onChange={(value) => (exposureStops.value = value)}
        onReset={exposureStops.value === 0 ? undefined : () => (exposureStops.value = 0)}
      />
      <Switch label="Show the light behind the object" value={sky.value} onChange={(value) => (sky.value = value)} />
    </Section>
  );
}

/** The object's own materials, then presets; a variant stands in for the preset of its name. */
function MaterialSection({ object }: { object: PageObject }) {
  const own = object.materials;
  const names = [...own, ...PRESETS.map(({ name }) => name).filter((name) => !own.includes(name))];
  const chosen = chosenMaterial(object);
  const hand = { roughness: roughness.value !== null, metallic: metallic.value !== null, tint: tint.value !== WHITE };
  return (
    <Section title="Material">
      <fieldset class="choice">
        <legend class="visually-hidden">Material</legend>
        <div class="choice-row grid materials">
          {names.map((name) => (
            <label>
              <input type="radio" name="material" value={name} checked={name === chosen} onChange={() => (own.includes(name) ? chooseWorn(own.indexOf(name)) : choosePreset(name))} />
              <span>{name}</span>
            </label>
          ))}
        </div>
      </fieldset>
      <Slider
        label="Roughness"
        value={material.value.roughness ?? MIDDLE}
        unset={material.value.roughness === null}
        min={0}
        max={1}
        step={0.01}
        onChange={(value) => (roughness.value = value)}
        onReset={hand.roughness ? () => (roughness.value = null) : undefined}
      />
      <Slider
        label="Metallic"
        value={material.value.metallic ?? MIDDLE}
        unset={material.value.metallic === null}
        min={0}
        max={1}
        step={0.01}
        onChange={(value) => (metallic.value = value)}
        onReset={hand.metallic ? () => (metallic.value = null) : undefined}
      />
      <div class={`field tint${hand.tint ? '' : ' unset'}`}>
        <label for="tint">Tint</label>
        <input id="tint" type="color" value={hexFromLinear(tint.value)} onInput={(event) => (tint.value = linearFromHex(event.currentTarget.value) ?? WHITE)} />
        <span class="hint">colours the object</span>
        <button class="reset" title="Reset tint" aria-label="Reset tint" disabled={!hand.tint} onClick={() => (tint.value = WHITE)}>
          <Icon name="reset" />
        </button>
      </div>
    </Section>
  );
}

const chosenMaterial = (object: PageObject) => preset.value ?? object.materials[worn.value]!;

function About({ object }: { object: PageObject }) {
  const [announced, setAnnounced] = useState('');
  useSignalEffect(() => setAnnounced(`${object.lights[chosenLight.value]!.name}, ${chosenMaterial(object)}`));
  const { kept, all } = object.faces;
  const count = (value: number) => value.toLocaleString('en');
  return (
    <Section title="About" open={false}>
      <p class="hint">
        {object.photographs > 0 && `Captured from ${object.photographs} photographs. `}
        Made with DR-GS; {kept < all ? `${count(kept)} of ${count(all)} faces are in this page.` : `${count(all)} faces.`} Nothing is loaded from elsewhere.
      </p>
      <p class="hint">
        Drag to go round, two fingers or <kbd>Shift</kbd> to move, pinch or wheel to come nearer, <kbd>Alt</kbd> to turn the light. On the picture: arrow keys, <kbd>+</kbd>
        <kbd>-</kbd>
        <kbd>F</kbd> and the space bar.
      </p>
      <p class="visually-hidden" role="status">
        {announced}
      </p>
    </Section>
  );
}

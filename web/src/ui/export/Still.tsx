/** One finished picture, rendered by the server for the camera on screen; of another size than the window's, with what the camera turns round in its middle. */

import { signal } from '@preact/signals';
import * as api from '../../session/api';
import { attempt } from '../../session/notices';
import { MAX_LAYERED_PIXELS, MAX_SIDE, MAX_STILL_PIXELS } from '../../session/protocol.gen';
import { session, settings } from '../../session/session';
import { aimNow, viewNow } from '../../session/view';
import { worldFromCamera } from '../../stage/camera/camera_path';
import { download } from '../download';
import { Choice, NumberField, Section, Switch } from '../fields';
import { Icon } from '../icons';
import { titleFor } from '../shortcuts';
import { LEAST_SIDE, sizeLimit, sizeTrouble, type Size } from './still_size';

const SIZES = [
  { value: 'window', text: 'Window', size: null },
  { value: 'hd', text: '1920×1080', size: { width: 1920, height: 1080 } },
  { value: 'square', text: '1024²', size: { width: 1024, height: 1024 } },
  { value: 'uhd', text: '3840×2160', size: { width: 3840, height: 2160 } },
] as const;
type SizeName = (typeof SIZES)[number]['value'];

/** Null: that of the window. */
const chosenSize = signal<Size | null>(null);
const samples = signal('128');
type StillFile = api.StillFormat | 'layers';
const format = signal<StillFile>('png');
const transparent = signal(false);
/** Ends the picture that the server is rendering; null while there is none. */
const rendering = signal<AbortController | null>(null);

const FORMATS: { value: StillFile; text: string; title: string }[] = [
  { value: 'png', text: 'PNG', title: 'As on screen: 8 bits, sRGB, with exposure and tone curve' },
  { value: 'exr', text: 'EXR', title: 'The light itself: linear 32-bit floats without exposure or tone curve, for compositing' },
  { value: 'layers', text: 'All channels', title: 'Light, albedo, normals, depth and every other channel as layers of one EXR, of the object alone' },
];

async function saveStill(size: Size): Promise<void> {
  const open = session.value;
  const view = chosenSize.value && aimNow.value ? { ...size, fov_y_degrees: aimNow.value.fov_y_degrees, world_from_camera: worldFromCamera(aimNow.value) } : viewNow.value;
  if (!view || !open) return;
  const leaving = (rendering.value = new AbortController());
  const kind = format.value;
  const suffix = kind === 'png' ? 'png' : 'exr';
  const wanted = { ...settings.value, spp_target: Number(samples.value), ...(kind !== 'png' && { exposure_stops: 0 }), ...(kind === 'layers' && { channel: 'all' as const }) };
  const picture = await attempt(api.stillPicture(open.id, api.frameQuery(view, size, wanted, transparent.value), suffix, leaving.signal));
  rendering.value = null;
  if (picture) download(picture, `${open.assetName}.${suffix}`);
}

export function Still() {
  const size = chosenSize.value ?? viewNow.value ?? { width: 0, height: 0 };
  const { width, height } = size;
  const known = SIZES.find((preset) => (preset.size ? preset.size.width === chosenSize.value?.width && preset.size.height === chosenSize.value.height : !chosenSize.value));
  const layered = format.value === 'layers';
  const most = layered ? MAX_LAYERED_PIXELS : MAX_STILL_PIXELS;
  const trouble = viewNow.value && sizeTrouble(size, Number(samples.value), most);
  const choose = (name: SizeName) => (chosenSize.value = SIZES.find(({ value }) => value === name)!.size);
  return (
    <Section title="Picture">
      <Choice label="Size" value={known?.value ?? null} options={[...SIZES]} onChange={choose} />
      <div class="pair">
        <NumberField label="Width" unit="px" value={width} min={LEAST_SIDE} max={MAX_SIDE} step={1} onEnter={(value) => (chosenSize.value = { width: Math.round(value), height })} />
        <NumberField label="Height" unit="px" value={height} min={LEAST_SIDE} max={MAX_SIDE} step={1} onEnter={(value) => (chosenSize.value = { width, height: Math.round(value) })} />
      </div>
      <Choice label="Samples a pixel" value={samples.value} options={['32', '128', '512'].map((value) => ({ value, text: value }))} onChange={(value) => (samples.value = value)} />
      <p class={trouble ? 'warning' : 'hint'}>{trouble ?? sizeLimit(Number(samples.value), most)}</p>
      <Choice label="File" value={format.value} options={FORMATS} onChange={(value) => (format.value = value)} />
      {!layered && <Switch label="Transparent background" title="With alpha; in an EXR colours are multiplied with it, as compositing programs want them" value={transparent.value} onChange={(value) => (transparent.value = value)} />}
      <div class="buttons">
        <button class="primary" disabled={rendering.value !== null || !viewNow.value || trouble !== null} onClick={() => void saveStill(size)}>
          <Icon name="camera" /> {rendering.value ? 'Rendering…' : layered ? 'Render all channels' : `Render ${format.value.toUpperCase()}`}
        </button>
        {rendering.value && (
          <button title="The server stops rendering it" onClick={() => rendering.value?.abort()}>
            Cancel
          </button>
        )}
      </div>
      <p class="hint">{titleFor('still', 'What is on screen is saved at once')}.</p>
    </Section>
  );
}

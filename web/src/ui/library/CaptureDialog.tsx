/** A capture before its build: where its pictures were taken from, what the doctor says, all pictures with their masks, and how it is to be built. */

import { useEffect, useRef, useState } from 'preact/hooks';
import * as api from '../../session/api';
import { capture, captureLook, captureTrouble, closeCapture, refreshCaptures } from '../../session/captures';
import { buildCapture } from '../../session/jobs';
import { attempt } from '../../session/notices';
import type { CaptureInfo, CaptureLook } from '../../session/protocol.gen';
import type { Vec3 } from '../../session/view';
import type { CapturePicture } from '../../stage/capture_picture';
import { Choice, PlaceField } from '../fields';
import { Icon } from '../icons';
import { theme } from '../layout';
import { build, BuildChoices } from './BuildChoices';
import { Findings } from './Findings';

const UPRIGHT: Vec3 = [0, 0, 1];
/** Cosine of the lean beyond which a capture's z is probably not up: cameras that look steeply down lean by up to this. */
const LEAST_UPRIGHT = 0.3;

export function CaptureDialog() {
  const dialog = useRef<HTMLDialogElement>(null);
  const info = capture.value;
  useEffect(() => {
    if (info) dialog.current?.showModal();
    else dialog.current?.close();
  }, [info]);
  return (
    <dialog ref={dialog} class="capture" aria-labelledby="capture-title" onClose={closeCapture} onClick={(event) => event.target === dialog.current && dialog.current?.close()}>
      <header>
        <h2 id="capture-title">{info?.name}</h2>
        <button class="ghost" aria-label="Close" onClick={() => dialog.current?.close()}>
          <Icon name="close" />
        </button>
      </header>
      {info && <Look info={info} look={captureLook.value} trouble={captureTrouble.value} />}
    </dialog>
  );
}

function Look({ info, look, trouble }: { info: CaptureInfo; look: CaptureLook | null; trouble: string | null }) {
  const [chosen, setUp] = useState<Vec3 | null>(null);
  const up = chosen ?? likelyUp(look);
  return (
    <>
      <div class="capture-top">
        {look && look.cameras.length > 0 ? <Cameras look={look} up={up} /> : <p class="capture-picture hint">{look ? withoutCameras(look) : (trouble ?? 'The server is looking at the pictures…')}</p>}
        <div class="capture-side section">
          {look && <Findings report={look} said={null} open />}
          <BuildForm info={info} look={look} ok={look?.ok ?? trouble !== null} up={up} onUp={setUp} />
        </div>
      </div>
      {look?.has_sheet && (
        <>
          <p class="hint sheet-head">
            All pictures, with the outlines of their masks.{' '}
            <a href={api.captureSheet(info.id)} target="_blank" rel="noopener">
              Larger
            </a>
          </p>
          <img class="sheet" src={api.captureSheet(info.id)} alt={`All pictures of ${info.name}, with the outlines of their masks`} />
        </>
      )}
    </>
  );
}

function withoutCameras(look: CaptureLook): string {
  return look.ok ? 'Where the pictures were taken from is found as the first step of a build.' : 'Where the pictures were taken from cannot be shown.';
}

/** As the file has it; as the cameras were held, where that is quite another direction. */
function likelyUp(look: CaptureLook | null): Vec3 {
  const held = look?.up;
  return held && held[2] < LEAST_UPRIGHT ? held : UPRIGHT;
}

/** The choices stand in a form of their own: those of the library are the same, and radio buttons are one group a form. */
function BuildForm({ info, look, ok, up, onUp }: { info: CaptureInfo; look: CaptureLook | null; ok: boolean; up: Vec3; onUp(up: Vec3): void }) {
  const [busy, setBusy] = useState(false);
  const start = async () => {
    setBusy(true);
    const job = await buildCapture(info, build.value, up);
    setBusy(false);
    if (!job) return;
    closeCapture();
    await attempt(refreshCaptures());
  };
  return (
    <form
      class="section-body"
      onSubmit={(event) => {
        event.preventDefault();
        void start();
      }}
      onKeyDown={(event) => {
        // Else whoever ends a number with it would begin the build.
        if (event.key !== 'Enter' || !(event.target instanceof HTMLInputElement)) return;
        event.preventDefault();
        event.target.blur();
      }}
    >
      {look?.up && <Up held={look.up} up={up} onUp={onUp} />}
      <BuildChoices />
      <button class="primary" disabled={busy || !ok}>
        Build
      </button>
    </form>
  );
}

function Up({ held, up, onUp }: { held: Vec3; up: Vec3; onUp(up: Vec3): void }) {
  const is = (other: Vec3) => other.every((value, i) => value === up[i]);
  const value = is(UPRIGHT) ? 'file' : is(held) ? 'held' : null;
  return (
    <div class="up">
      <Choice
        label="Up is"
        value={value}
        options={[
          { value: 'file', text: 'As in the file', title: 'Its z axis. COLMAP’s own worlds have no up' },
          { value: 'held', text: 'As held', title: 'As the camera was held, on average' },
        ]}
        onChange={(chosen) => onUp(chosen === 'file' ? UPRIGHT : held)}
      />
      {held[2] < LEAST_UPRIGHT && <p class="hint">The file’s z is far from how the camera was held, so that is proposed.</p>}
      <PlaceField label="Direction" value={up} step={0.001} onEnter={(entered) => Math.hypot(...entered) > 0 && onUp(entered)} />
    </div>
  );
}

function Cameras({ look, up }: { look: CaptureLook; up: Vec3 }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const picture = useRef<CapturePicture | null>(null);
  const [missing, setMissing] = useState(false);
  useEffect(() => {
    let gone = false;
    void import('../../stage/capture_picture').then(({ CapturePicture }) => {
      if (gone) return;
      try {
        picture.current = new CapturePicture(canvas.current!);
        picture.current.show(look, up);
      } catch {
        setMissing(true);
      }
    });
    return () => {
      gone = true;
      picture.current?.dispose();
      picture.current = null;
    };
  }, [look]);
  useEffect(() => picture.current?.show(look, up), [theme.value, up]);
  if (missing) return <p class="capture-picture hint">This browser offers no WebGL 2, so the cameras cannot be drawn.</p>;
  const shown = look.cameras.length < look.camera_count ? `${look.cameras.length} of ${look.camera_count}` : String(look.camera_count);
  return (
    <figure class="capture-picture">
      <canvas ref={canvas} role="img" aria-label={`${shown} cameras around the object. Drag to turn it.`} />
      <figcaption class="hint">
        {shown} cameras; the box is {look.box_origin === 'masks' ? 'what the masks allow' : 'what all cameras see'}. Drag to turn, scroll to zoom.
      </figcaption>
    </figure>
  );
}

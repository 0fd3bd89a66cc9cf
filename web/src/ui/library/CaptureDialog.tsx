/** A capture before its build: where its pictures were taken from, what the doctor says, all pictures with their masks, and how it is to be built. */

import { useEffect, useMemo, useRef, useState } from 'preact/hooks';
import { foundBox, SIDES, stepOf, valueOf, withSide } from '../../capture/build_box';
import { tileStyle } from '../../capture/sheet_tiles';
import { areEnough, tileAt } from '../../capture/strokes';
import * as api from '../../session/api';
import { capture, captureLook, captureTrouble, closeCapture, refreshCaptures } from '../../session/captures';
import { buildCapture, isActive, jobs } from '../../session/jobs';
import { attempt } from '../../session/notices';
import type { BoxCorners, CaptureInfo, CaptureLook, CaptureMasks, SheetLayout, Stroke } from '../../session/protocol.gen';
import type { Vec3 } from '../../session/view';
import { Choice, PlaceField } from '../fields';
import { Icon } from '../icons';
import { build, BuildChoices } from './BuildChoices';
import { CaptureView } from './CaptureView';
import { Findings } from './Findings';
import { Poses, searchOf } from './Poses';
import { Strokes } from './Strokes';

const UPRIGHT: Vec3 = [0, 0, 1];
/** Cosine of the lean beyond which a capture's z is probably not up: cameras that look steeply down lean by up to this. */
const LEAST_UPRIGHT = 0.3;

export function CaptureDialog() {
  const dialog = useRef<HTMLDialogElement>(null);
  const info = capture.value;
  useEffect(() => {
    if (info && !dialog.current?.open) dialog.current?.showModal();
    else if (!info) dialog.current?.close();
  }, [info]);
  return (
    <dialog ref={dialog} class="capture" aria-labelledby="capture-title" onClose={closeCapture} onClick={(event) => event.target === dialog.current && dialog.current?.close()}>
      <header>
        <h2 id="capture-title">{info?.name}</h2>
        <button class="ghost" aria-label="Close" onClick={() => dialog.current?.close()}>
          <Icon name="close" />
        </button>
      </header>
      {info && <Look key={info.id} info={info} look={captureLook.value} trouble={captureTrouble.value} />}
    </dialog>
  );
}

function Look({ info, look, trouble }: { info: CaptureInfo; look: CaptureLook | null; trouble: string | null }) {
  const [chosenUp, setUp] = useState<Vec3 | null>(null);
  const [movedBox, setBox] = useState<BoxCorners | null>(null);
  const [strokes, setStrokes] = useState<Stroke[]>([]);
  const [masks, setMasks] = useState<CaptureMasks | null>(null);
  const [isStroking, setStroking] = useState(false);
  const [picture, setPicture] = useState(0);
  const up = chosenUp ?? likelyUp(look);
  const found = useMemo(() => look && foundBox(look, up), [look, ...up]);
  const box = movedBox ?? found;
  const turn = (to: Vec3 | null) => {
    setUp(to);
    setBox(null); // its sides lie along the axes of the world as it was turned before
  };
  const poses = jobs.value.find((job) => job.capture_id === info.id)?.capture;
  const search = searchOf(info);
  const searching = search !== undefined && isActive(search);
  const shape = look?.up && found && box ? { held: look.up, up, isAuto: chosenUp === null, onUp: turn, found, box, isFound: movedBox === null, onBox: setBox } : null;
  return (
    <>
      <div class="capture-top">
        {look && shape ? (
          <CaptureView look={look} {...shape} />
        ) : look?.ok ? (
          <Poses info={info} />
        ) : (
          <p class="capture-picture hint">{look ? 'Where the pictures were taken from cannot be shown.' : (trouble ?? 'The server is looking at the pictures…')}</p>
        )}
        <div class="capture-side section">
          {poses && (poses.findings.length > 0 ? <Findings report={poses} said={null} open /> : <p class="facts">{poses.summary}</p>)}
          {look && <Findings report={look} said={null} open />}
          <BuildForm info={info} ok={(look?.ok ?? trouble !== null) && !searching} shape={shape} strokes={areEnough(strokes) ? strokes : null} />
        </div>
      </div>
      {look && look.cameras.length > 0 && (
        <details class="section" open={isStroking} onToggle={(event) => setStroking(event.currentTarget.open)}>
          <summary>Mark the object by strokes</summary>
          {isStroking && <Strokes info={info} look={look} number={picture} onNumber={setPicture} strokes={strokes} onStrokes={setStrokes} onMasks={setMasks} />}
        </details>
      )}
      {look?.has_sheet && <Sheet info={info} look={look} masks={masks} onPicture={isStroking ? setPicture : null} />}
    </>
  );
}

/** All pictures with their masks: the capture's own, or those that strokes give. `onPicture`: told the number of a picture that is clicked; null: nobody asks. */
function Sheet({ info, look, masks, onPicture }: { info: CaptureInfo; look: CaptureLook; masks: CaptureMasks | null; onPicture: ((number: number) => void) | null }) {
  const sheet = masks ? api.masksSheet(info.id, masks.version) : api.captureSheet(info.id);
  const layout = masks?.sheet ?? look.sheet;
  // Of many pictures the sheet shows others than the look does.
  const choose = layout?.count === look.cameras.length ? onPicture : null;
  const click = (event: MouseEvent) => {
    const shown = (event.currentTarget as Element).getBoundingClientRect();
    const number = layout && tileAt(layout, [(event.clientX - shown.left) / shown.width, (event.clientY - shown.top) / shown.height]);
    if (number !== null && number !== undefined) choose?.(number);
  };
  return (
    <>
      <p class="hint sheet-head">
        All pictures, with the outlines of {masks ? 'the masks that the strokes give' : 'their masks'}.{' '}
        <a href={sheet} target="_blank" rel="noopener">
          Larger
        </a>
      </p>
      <img class={layout ? 'sheet tiled' : 'sheet'} src={sheet} alt={`All pictures of ${info.name}, with the outlines of ${masks ? 'the masks that the strokes give' : 'their masks'}`} onClick={click} />
      {layout && <Tiles layout={layout} sheet={sheet} name={info.name} onPicture={choose} />}
    </>
  );
}

/** The sheet's pictures in as many columns as a narrow window has room for. */
function Tiles({ layout, sheet, name, onPicture }: { layout: SheetLayout; sheet: string; name: string; onPicture: ((number: number) => void) | null }) {
  return (
    <ul class="tiles" aria-label={`Pictures of ${name}`}>
      {Array.from({ length: layout.count }, (_, number) => (
        <li key={number} style={tileStyle(layout, sheet, number)} onClick={() => onPicture?.(number)} />
      ))}
    </ul>
  );
}

/** As the file has it; as the cameras were held, where that is quite another direction. */
function likelyUp(look: CaptureLook | null): Vec3 {
  const held = look?.up;
  return held && held[2] < LEAST_UPRIGHT ? held : UPRIGHT;
}

/** Which way is up, and what is built. Null where there are no cameras yet: then nothing of it can be shown. */
interface Shape {
  /** The mean of the cameras' own up. */
  held: Vec3;
  up: Vec3;
  /** Nobody has chosen it. */
  isAuto: boolean;
  /** Null: as proposed. */
  onUp(up: Vec3 | null): void;
  found: BoxCorners;
  /** Of the world that is turned so that `up` is z. */
  box: BoxCorners;
  /** Nobody has moved it; then a build is told none. */
  isFound: boolean;
  /** Null: as found. */
  onBox(box: BoxCorners | null): void;
}

/** The choices stand in a form of their own: those of the library are the same, and radio buttons are one group a form. */
function BuildForm({ info, ok, shape, strokes }: { info: CaptureInfo; ok: boolean; shape: Shape | null; strokes: Stroke[] | null }) {
  const [busy, setBusy] = useState(false);
  const start = async () => {
    setBusy(true);
    const job = await buildCapture(info, build.value, shape?.up ?? UPRIGHT, shape && !shape.isFound ? shape.box : null, strokes);
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
      {shape && <Up {...shape} />}
      {shape && <Box {...shape} />}
      <BuildChoices />
      <button class="primary" disabled={busy || !ok}>
        Build
      </button>
    </form>
  );
}

function Up({ held, up, isAuto, onUp }: Shape) {
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
      <button type="button" class="small" disabled={isAuto} title="As it was proposed" onClick={() => onUp(null)}>
        Auto
      </button>
    </div>
  );
}

function Box({ found, box, isFound, onBox }: Shape) {
  const enter = (high: boolean) => (entered: Vec3) => onBox(SIDES.filter((side) => side.high === high && entered[side.axis] !== shown(high)[side.axis]).reduce((moved, side) => withSide(moved, side, entered[side.axis], found), box));
  const step = 10 ** Math.floor(Math.log10(stepOf(found)));
  const shown = (high: boolean) => SIDES.filter((side) => side.high === high).map((side) => valueOf(box, side)) as Vec3;
  return (
    <div class="up">
      <PlaceField label="Box from" value={shown(false)} step={step} onEnter={enter(false)} />
      <PlaceField label="Box to" value={shown(true)} step={step} onEnter={enter(true)} />
      <div class="beside">
        <p class="hint">{isFound ? 'All of the object is built.' : 'What lies outside is not built. Another up takes the box back.'}</p>
        <button type="button" class="small" disabled={isFound} title="Build all of the object" onClick={() => onBox(null)}>
          As found
        </button>
      </div>
    </div>
  );
}

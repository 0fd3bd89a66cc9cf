/** The page: full-window stage, panels over it, files dropped anywhere. */

import { useEffect, useRef, useState } from 'preact/hooks';
import { droppedFiles } from '../capture/dropped_files';
import { showPhotographs, stepView, viewNumber } from '../capture/photographs';
import { copyMaterial, pasteMaterial } from '../edit/material/presets';
import { flash, selectAll } from '../edit/material/selection';
import { choose, gizmoMode, removeChosen } from '../edit/shape/shape_tools';
import { log, redo, undo } from '../session/edit_log';
import { assets } from '../session/library';
import { attempt, dismiss, notices, notify } from '../session/notices';
import { changeSettings, session } from '../session/session';
import { CHANNELS } from '../stage/channels';
import { before, flying, localPicture, wireframe } from '../stage/switches';
import type { Viewport } from '../stage/viewport';
import { Compare, toggleSplit } from './Compare';
import { Help } from './Help';
import { Hud } from './Hud';
import { download } from './download';
import { Icon } from './icons';
import { Inspector } from './inspector/Inspector';
import { atView, helpOpen, inspectorShown, libraryOpen, onPhone, theme, toggleInspector } from './layout';
import { CaptureDialog } from './library/CaptureDialog';
import { Library, takeFiles } from './library/Library';
import { LightsDialog } from './LightsDialog';
import { listenForKeys, titleFor, type Actions } from './shortcuts';

export function App() {
  const stage = useRef<HTMLDivElement>(null);
  const traced = useRef<HTMLCanvasElement>(null);
  const local = useRef<HTMLCanvasElement>(null);
  const viewport = useRef<Viewport | null>(null);

  const saveStill = async () => {
    const picture = await viewport.current?.still();
    if (!picture) return notify('There is no traced picture to save yet.');
    download(picture, `${session.value?.assetName ?? 'picture'}.png`);
  };

  useEffect(() => {
    let gone = false;
    // three.js comes in its own file: panels and builds do not wait for it.
    void import('../stage/viewport').then(({ Viewport }) => {
      if (!gone) viewport.current = new Viewport(stage.current!, traced.current!, local.current!);
    });
    const actions: Actions = {
      frame: () => viewport.current?.frame(),
      home: () => viewport.current?.reset(),
      undo,
      redo,
      help: () => (helpOpen.value = !helpOpen.value),
      escape: () => {
        helpOpen.value = flying.value = false;
        choose(null);
        viewNumber.value = null;
        (document.activeElement as HTMLElement | null)?.blur();
      },
      fly: () => session.value && (flying.value = !flying.value),
      all: selectAll,
      show: () => flash.value++,
      remove: removeChosen,
      turn: () => (gizmoMode.value = gizmoMode.value === 'rotate' ? 'translate' : 'rotate'),
      copy: copyMaterial,
      paste: pasteMaterial,
      before: () => (before.value = true),
      local: () => (localPicture.value = !localPicture.value),
      theme: () => (theme.value = theme.value === 'dark' ? 'light' : 'dark'),
      library: () => (libraryOpen.value = !libraryOpen.value),
      inspector: toggleInspector,
      ...Object.fromEntries(CHANNELS.map(({ value }, i) => [`channel${i + 1}`, () => changeSettings({ channel: value })])),
      wireframe: () => session.value && (wireframe.value = !wireframe.value),
      photographs: () => session.value && showPhotographs(viewNumber.value === null),
      previousView: () => stepView(-1),
      nextView: () => stepView(1),
      split: () => session.value && toggleSplit(),
      still: () => void saveStill(),
    };
    const silence = listenForKeys(actions, { before: () => (before.value = false) }, () => flying.value);
    return () => {
      gone = true;
      silence();
    };
  }, []);

  useEffect(() => {
    document.documentElement.dataset.theme = theme.value;
  }, [theme.value]);

  const covered = `${inspectorShown.value} ${libraryOpen.value} ${atView.value}`;
  useEffect(() => {
    if (onPhone.value) viewport.current?.keepClear();
  }, [covered]);

  return (
    <>
      <div ref={stage} class="stage" tabIndex={0} role="application" aria-label="Picture of the object. Arrow keys orbit, plus and minus zoom.">
        <canvas ref={local} class="local" aria-hidden="true" />
        <canvas ref={traced} class="traced" aria-hidden="true" />
      </div>
      <Compare />
      {!session.value && <Welcome />}
      <TopBar onFrame={() => viewport.current?.frame()} />
      <Library />
      <Inspector />
      <Hud />
      <Notices />
      <DropZone />
      <Help />
      <LightsDialog />
      <CaptureDialog />
    </>
  );
}

function TopBar({ onFrame }: { onFrame(): void }) {
  const open = session.value;
  const isDark = theme.value === 'dark';
  return (
    <header class="topbar">
      <button class="ghost" aria-pressed={libraryOpen.value} title={titleFor('library')} aria-label="Library" onClick={() => (libraryOpen.value = !libraryOpen.value)}>
        <Icon name="library" />
      </button>
      <h1>{open ? open.assetName : 'DR-GS'}</h1>
      <span class="spacer" />
      {open && (
        <>
          <button class="ghost" disabled={!log.value.can_undo} title={titleFor('undo')} aria-label="Undo" onClick={undo}>
            <Icon name="undo" />
          </button>
          <button class="ghost" disabled={!log.value.can_redo} title={titleFor('redo')} aria-label="Redo" onClick={redo}>
            <Icon name="redo" />
          </button>
          <button class="ghost" title={titleFor('frame')} aria-label="Frame the object" onClick={onFrame}>
            <Icon name="frame" />
          </button>
        </>
      )}
      <button class="ghost" title={titleFor('theme', isDark ? 'Light theme' : 'Dark theme')} aria-label={isDark ? 'Light theme' : 'Dark theme'} onClick={() => (theme.value = isDark ? 'light' : 'dark')}>
        <Icon name={isDark ? 'sun' : 'moon'} />
      </button>
      <button class="ghost" title={titleFor('help', 'Keys and gestures')} aria-label="Keys and gestures" onClick={() => (helpOpen.value = true)}>
        <Icon name="help" />
      </button>
      {open && (
        <button class="ghost" aria-pressed={inspectorShown.value} title={titleFor('inspector')} aria-label="Inspector" onClick={toggleInspector}>
          <Icon name="inspector" />
        </button>
      )}
    </header>
  );
}

function Welcome() {
  return (
    <div class="welcome">
      <h2>{assets.value?.length ? 'Open an asset from the library' : 'No asset is open'}</h2>
      <p>Photos of an object go in; out comes an object that can be put under another light and given another material.</p>
      {!libraryOpen.value && (
        <button class="primary" onClick={() => (libraryOpen.value = true)}>
          Show the library
        </button>
      )}
    </div>
  );
}

function Notices() {
  return (
    <div class="notices" role="log" aria-live="polite" aria-label="Messages">
      {notices.value.map((notice) => (
        <div key={notice.id} class={`notice ${notice.kind}`}>
          <p>{notice.text}</p>
          <button class="ghost" aria-label="Dismiss" onClick={() => dismiss(notice.id)}>
            <Icon name="close" />
          </button>
        </div>
      ))}
    </div>
  );
}

/** Covers the page while files hang over it, so that a drop anywhere is taken and none makes the browser leave the page. */
function DropZone() {
  const [over, setOver] = useState(false);
  useEffect(() => {
    const carriesFiles = (event: DragEvent) => event.dataTransfer?.types.includes('Files') ?? false;
    const enter = (event: DragEvent) => {
      if (!carriesFiles(event)) return;
      event.preventDefault();
      setOver(true);
    };
    const leave = (event: DragEvent) => event.relatedTarget === null && setOver(false);
    const drop = (event: DragEvent) => {
      if (!carriesFiles(event)) return;
      event.preventDefault();
      setOver(false);
      void attempt(droppedFiles(event.dataTransfer!)).then((files) => takeFiles(files ?? []));
    };
    window.addEventListener('dragenter', enter);
    window.addEventListener('dragover', enter);
    window.addEventListener('dragleave', leave);
    window.addEventListener('drop', drop);
    return () => {
      window.removeEventListener('dragenter', enter);
      window.removeEventListener('dragover', enter);
      window.removeEventListener('dragleave', leave);
      window.removeEventListener('drop', drop);
    };
  }, []);
  return over ? (
    <div class="dropzone">
      <p>Drop photos, their folder, a film, a capture (.zip), an asset’s folder, a mesh (.glb, .obj, .ply) or a light (.exr, .hdr)</p>
    </div>
  ) : null;
}

/** The `?` overlay, written from the shortcut table. */

import { useEffect, useRef } from 'preact/hooks';
import { Icon } from './icons';
import { helpOpen } from './layout';
import { chordText, shortcuts } from './shortcuts';

export function Help() {
  const dialog = useRef<HTMLDialogElement>(null);
  useEffect(() => {
    if (helpOpen.value) dialog.current?.showModal();
    else dialog.current?.close();
  }, [helpOpen.value]);
  const groups = [...new Set(shortcuts.map((shortcut) => shortcut.group))];
  return (
    <dialog ref={dialog} class="help" aria-labelledby="help-title" onClose={() => (helpOpen.value = false)} onClick={(event) => event.target === dialog.current && dialog.current?.close()}>
      <header>
        <h2 id="help-title">Keys and gestures</h2>
        <button class="ghost" aria-label="Close" onClick={() => dialog.current?.close()}>
          <Icon name="close" />
        </button>
      </header>
      <div class="help-groups">
        {groups.map((group) => (
          <section>
            <h3>{group}</h3>
            <dl>
              {shortcuts
                .filter((shortcut) => shortcut.group === group)
                .map((shortcut) => (
                  <div>
                    <dt>{shortcut.gesture ?? shortcut.chords.map((chord) => <kbd>{chordText(chord)}</kbd>)}</dt>
                    <dd>{shortcut.text}</dd>
                  </div>
                ))}
            </dl>
          </section>
        ))}
      </div>
    </dialog>
  );
}

/** The one table of keys: it feeds the keyboard handler, the tool-tips and the `?` help. Pointer rows are for the help only. */

interface Shortcut {
  group: 'Camera' | 'Light' | 'Edit' | 'Shape' | 'View' | 'Panels';
  /** As `chordOf` writes it, e.g. `mod+shift+z`; several chords may do the same. Empty for pointer gestures. */
  chords: string[];
  /** What the help shows for a gesture without keys. */
  gesture?: string;
  text: string;
  action?: ActionName;
}

export type ActionName =
  | 'frame' | 'home' | 'undo' | 'redo' | 'help' | 'escape' | 'local' | 'theme' | 'library' | 'inspector'
  | 'channel1' | 'channel2' | 'channel3' | 'channel4' | 'channel5' | 'channel6' | 'channel7' | 'channel8' | 'channel9' | 'channel10' | 'channel11'
  | 'wireframe' | 'still' | 'remove' | 'turn' | 'before' | 'fly' | 'all' | 'copy' | 'paste' | 'show'
  | 'photographs' | 'previousView' | 'nextView' | 'split';

export const shortcuts: Shortcut[] = [
  { group: 'Camera', chords: [], gesture: 'Left drag, one finger', text: 'Orbit' },
  { group: 'Camera', chords: [], gesture: 'Right drag, Shift+middle drag, two fingers', text: 'Pan' },
  { group: 'Camera', chords: [], gesture: 'Wheel, Ctrl+middle drag, pinch', text: 'Zoom' },
  { group: 'Camera', chords: [], gesture: 'Double-click, double tap', text: 'Put the focal point on the surface' },
  { group: 'Camera', chords: ['f'], text: 'Frame the object', action: 'frame' },
  { group: 'Camera', chords: ['shift+f'], text: 'Reset the camera', action: 'home' },
  { group: 'Camera', chords: ['v'], text: 'Fly, or orbit again', action: 'fly' },
  { group: 'Camera', chords: [], gesture: 'W A S D, Q E (flying)', text: 'Move; Shift faster, Alt slower' },
  { group: 'Light', chords: [], gesture: 'Alt+drag, Shift+right drag', text: 'Turn the environment' },
  { group: 'Edit', chords: ['mod+z'], text: 'Undo', action: 'undo' },
  { group: 'Edit', chords: ['mod+shift+z', 'mod+y'], text: 'Redo', action: 'redo' },
  { group: 'Edit', chords: [], gesture: 'Click, with a tool chosen', text: 'Select a part' },
  { group: 'Edit', chords: ['a'], text: 'Select all', action: 'all' },
  { group: 'Edit', chords: ['s'], text: 'Show what is selected', action: 'show' },
  { group: 'Edit', chords: ['mod+c'], text: 'Copy the material', action: 'copy' },
  { group: 'Edit', chords: ['mod+v'], text: 'Paste the material', action: 'paste' },
  { group: 'Edit', chords: ['b'], gesture: 'B, held', text: 'See the object as captured', action: 'before' },
  { group: 'Edit', chords: ['shift+b'], text: 'Split the window: as captured, and now', action: 'split' },
  { group: 'Edit', chords: [], gesture: 'Double-click a slider', text: 'Take that value’s edits back' },
  { group: 'Shape', chords: [], gesture: 'Click, handles on', text: 'Put a handle, or choose one' },
  { group: 'Shape', chords: ['delete', 'backspace'], text: 'Remove the chosen handle', action: 'remove' },
  { group: 'Shape', chords: ['r'], text: 'Move or turn it', action: 'turn' },
  { group: 'View', chords: ['1'], text: 'Final picture', action: 'channel1' },
  { group: 'View', chords: ['2'], text: 'Albedo', action: 'channel2' },
  { group: 'View', chords: ['3'], text: 'Roughness', action: 'channel3' },
  { group: 'View', chords: ['4'], text: 'Metallic', action: 'channel4' },
  { group: 'View', chords: ['5'], text: 'Normal', action: 'channel5' },
  { group: 'View', chords: ['6'], text: 'Depth', action: 'channel6' },
  { group: 'View', chords: ['7'], text: 'Open sky (visibility)', action: 'channel7' },
  { group: 'View', chords: ['8'], text: 'Indirect light', action: 'channel8' },
  { group: 'View', chords: ['9'], text: 'Noise (variance)', action: 'channel9' },
  { group: 'View', chords: ['0'], text: 'Surfels', action: 'channel10' },
  { group: 'View', chords: ['u'], text: 'Certainty', action: 'channel11' },
  { group: 'View', chords: ['e'], text: 'Edges of the mesh', action: 'wireframe' },
  { group: 'View', chords: ['c'], text: 'Compare with a photograph, or leave it', action: 'photographs' },
  { group: 'View', chords: ['arrowleft'], text: 'Comparing: the photograph before', action: 'previousView' },
  { group: 'View', chords: ['arrowright'], text: 'Comparing: the next photograph', action: 'nextView' },
  { group: 'View', chords: ['p'], text: 'Instant local picture on or off', action: 'local' },
  { group: 'View', chords: ['mod+s'], text: 'Save the picture as PNG', action: 'still' },
  { group: 'Panels', chords: ['l'], text: 'Library', action: 'library' },
  { group: 'Panels', chords: ['i'], text: 'Inspector', action: 'inspector' },
  { group: 'Panels', chords: ['t'], text: 'Dark or light theme', action: 'theme' },
  { group: 'Panels', chords: ['?'], text: 'This list', action: 'help' },
  { group: 'Panels', chords: ['escape'], text: 'Close what is open, let go of the chosen handle', action: 'escape' },
];

const isApple = /Mac|iPhone|iPad/.test(navigator.platform);

/** `mod` stands for Ctrl, or ⌘ on Apple machines. Shift is named only beside letters and named keys: `?` already implies it. */
function chordOf(event: KeyboardEvent): string {
  const key = event.key.toLowerCase();
  const parts: string[] = [];
  if (isApple ? event.metaKey : event.ctrlKey) parts.push('mod');
  if (event.altKey) parts.push('alt');
  if (event.shiftKey && (key.length > 1 || key !== key.toUpperCase())) parts.push('shift');
  return [...parts, key].join('+');
}

export function chordText(chord: string): string {
  const modifiers = isApple ? { mod: '⌘', shift: '⇧', alt: '⌥', backspace: '⌫' } : { mod: 'Ctrl', shift: 'Shift', alt: 'Alt', backspace: 'Backspace' };
  const names: Record<string, string> = { ...modifiers, escape: 'Esc', delete: 'Del', arrowleft: '←', arrowright: '→' };
  return chord.split('+').map((part) => names[part] ?? part.toUpperCase()).join(isApple ? '' : '+');
}

/** Tool-tip text: what a button does and the key that does it too. */
export function titleFor(action: ActionName, text?: string): string {
  const entry = shortcuts.find((shortcut) => shortcut.action === action);
  const chord = entry?.chords[0];
  return `${text ?? entry?.text ?? action}${chord ? ` (${chordText(chord)})` : ''}`;
}

export type Actions = Partial<Record<ActionName, () => void>>;

/**
 * Route key presses to `actions`, and the release of a held key to `releases`; typing in a field keeps its own keys, except Escape.
 * The flying camera has the letters W A S D Q E for itself.
 */
export function listenForKeys(actions: Actions, releases: Actions, isFlying: () => boolean): () => void {
  const byChord = new Map(shortcuts.flatMap((entry) => entry.chords.map((chord) => [chord, entry.action] as const)));
  const onKey = (event: KeyboardEvent) => {
    const chord = chordOf(event);
    const target = event.target as HTMLElement;
    const typing = target.matches?.('input:not([type=range]):not([type=checkbox]):not([type=radio]):not([type=color]), textarea, select');
    if (typing && chord !== 'escape') return;
    if (isFlying() && /^(shift\+|alt\+)?[wasdqe]$/.test(chord)) return;
    // Tabs, sliders and radio buttons have their own use for these keys.
    if (/^arrow/.test(chord) && target.matches?.('input:not([type=checkbox]), [role=tab], [role=slider]')) return;
    const action = byChord.get(chord);
    const run = action && actions[action];
    if (!run || (action === 'copy' && String(getSelection()))) return;
    event.preventDefault();
    if (!event.repeat || !releases[action]) run();
  };
  const onRelease = (event: KeyboardEvent) => {
    const action = byChord.get(event.key.toLowerCase());
    if (action) releases[action]?.();
  };
  const releaseAll = () => Object.values(releases).forEach((release) => release());
  window.addEventListener('keydown', onKey);
  window.addEventListener('keyup', onRelease);
  window.addEventListener('blur', releaseAll);
  return () => {
    window.removeEventListener('keydown', onKey);
    window.removeEventListener('keyup', onRelease);
    window.removeEventListener('blur', releaseAll);
  };
}

/** The edits in force and those undone; a click goes to the state after that edit. One that the server skips says why, and can be taken out. */

import { describeEdit } from '../../edit/describe_edit';
import { broken, goTo, log, reviseEdits } from '../../session/edit_log';
import { Section } from '../fields';

export function History() {
  const { edits, undone } = log.value;
  const entry = (text: string, count: number, skipped?: string) => (
    <li key={count} class={skipped && 'broken'}>
      <button class={count > edits.length ? 'undone' : undefined} aria-current={count === edits.length ? 'step' : undefined} title={skipped ? `Skipped: ${skipped}` : count > edits.length ? `Redo up to here: ${text}` : text} onClick={() => goTo(count)}>
        {text}
      </button>
      {skipped && (
        <button class="take-out" aria-label={`Take out ${text}, which is skipped`} title="Take this edit out" onClick={() => reviseEdits((now) => now.filter((edit) => edit !== edits[count - 1]))}>
          ×
        </button>
      )}
    </li>
  );
  return (
    <Section title="History">
      <ol class="history" aria-label="Edits in force">
        {entry('As captured', 0)}
        {[...edits, ...undone].map((edit, i) => entry(describeEdit(edit), i + 1, broken.value.get(i)))}
      </ol>
    </Section>
  );
}

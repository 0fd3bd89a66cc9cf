/** The edits in force and those undone; a click goes to the state after that edit. */

import { describeEdit } from '../edit_log';
import { goTo } from '../session';
import { log } from '../state';
import { Section } from './fields';

export function History() {
  const { edits, undone } = log.value;
  const entry = (text: string, count: number) => (
    <li key={count}>
      <button class={count > edits.length ? 'undone' : undefined} aria-current={count === edits.length ? 'step' : undefined} title={count > edits.length ? `Redo up to here: ${text}` : text} onClick={() => goTo(count)}>
        {text}
      </button>
    </li>
  );
  return (
    <Section title="History">
      <ol class="history" aria-label="Edits in force">
        {entry('As captured', 0)}
        {[...edits, ...undone].map((edit, i) => entry(describeEdit(edit), i + 1))}
      </ol>
    </Section>
  );
}

/** Captures on the server: each can be looked at, built from, and removed. */

import { captures, openCapture, removeCapture } from '../../session/captures';
import { Section } from '../fields';
import { Icon } from '../icons';

export function Captures() {
  const list = captures.value;
  if (list.length === 0) return null;
  return (
    <Section title="Captures">
      <ul class="captures">
        {list.map((info) => (
          <li key={info.id}>
            <button class="name" title={`Look at ${info.name}`} onClick={() => void openCapture(info)}>
              {info.name}
            </button>
            <button class="ghost" title="Remove" aria-label={`Remove ${info.name}`} onClick={() => void removeCapture(info)}>
              <Icon name="close" />
            </button>
          </li>
        ))}
      </ul>
      <p class="hint">What nothing is built from is removed after a day.</p>
    </Section>
  );
}

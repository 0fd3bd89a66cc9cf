/** Pictures, films, files for other programs, and what is on screen as a script. */

import { log } from '../../session/edit_log';
import { notify } from '../../session/notices';
import { session, settings } from '../../session/session';
import { viewNow } from '../../session/view';
import { Section } from '../fields';
import { Files } from './Files';
import { Film } from './Film';
import { Still } from './Still';
import { asCurl, asEdits, asPython } from './scripts';

export function ExportPanel() {
  return (
    <>
      <Still />
      <Film />
      <Files />
      <Script />
    </>
  );
}

function Script() {
  const copy = async (text: string, what: string) => {
    try {
      await navigator.clipboard.writeText(text);
      notify(`${what} is on the clipboard.`, 'info');
    } catch {
      notify('The browser did not allow writing to the clipboard.');
    }
  };
  const now = () => ({ origin: location.origin, asset: session.value!.asset, session: session.value!.id, edits: log.value.edits, view: viewNow.value, settings: settings.value });
  return (
    <Section title="As a script">
      <div class="buttons">
        <button onClick={() => void copy(asPython(now()), 'Python for this picture')}>Copy as Python</button>
        <button onClick={() => void copy(asCurl(now()), 'A curl command for this picture')}>Copy as curl</button>
        <button onClick={() => void copy(asEdits(log.value.edits), 'The list of edits')}>Copy edits (JSON)</button>
      </div>
      <p class="hint">Scripts read the token from DRGS_TOKEN; edits are what `drgs render --edits` takes.</p>
    </Section>
  );
}

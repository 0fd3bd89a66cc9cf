/** Start: sign in with the link's token if there is one, then show the page. */

import { render } from 'preact';
import * as api from './session/api';
import { refreshCaptures } from './session/captures';
import { watchJobs } from './session/jobs';
import { refreshAssets, refreshEnvironments } from './session/library';
import { attempt } from './session/notices';
import { openAsset } from './session/session';
import { App } from './ui/App';
import './ui/style.css';

async function start(): Promise<void> {
  const fragment = new URLSearchParams(location.hash.slice(1));
  const token = fragment.get('token');
  if (token) {
    fragment.delete('token');
    const rest = fragment.toString();
    // Out of the address bar and the history before anything else can read or share it.
    history.replaceState(null, '', location.pathname + (rest ? `#${rest}` : ''));
    if ((await attempt(api.login(token).then(() => true))) === null) return;
  }
  await attempt(Promise.all([refreshAssets(), refreshEnvironments(), refreshCaptures()]));
  watchJobs();
  const asset = fragment.get('asset');
  if (asset) await openAsset(asset);
}

render(<App />, document.getElementById('app')!);
void start();

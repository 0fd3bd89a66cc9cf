/** Start of the page that `drgs export ASSET page.html` writes: unpack the object that the file holds, and show it. */

import { render } from 'preact';
import '../ui/style.css';
import { Page } from './Page';
import './page.css';
import { readObject } from './page_object';
import { unpackText } from './unpack_arrays';

const root = document.getElementById('app')!;

async function start(): Promise<void> {
  document.documentElement.dataset.theme = matchMedia('(prefers-color-scheme: light)').matches ? 'light' : 'dark';
  if (!('DecompressionStream' in window)) throw new Error('This browser is too old to unpack the page; those of 2023 and later can.');
  const packed = document.getElementById('object')!;
  const object = readObject(await unpackText(packed.textContent));
  packed.remove();
  render(<Page object={object} />, root);
}

function Trouble({ sentence }: { sentence: string }) {
  return (
    <div class="welcome" role="alert">
      <h2>The object cannot be shown</h2>
      <p>{sentence}</p>
    </div>
  );
}

start().catch((error: Error) => render(<Trouble sentence={error.message} />, root));

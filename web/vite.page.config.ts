import { createHash } from 'node:crypto';
import { defineConfig, type Plugin } from 'vite';

/** Puts script and style into the page, which then is one file, and allows the browser to run these and to load nothing. */
const intoOneFile: Plugin = {
  name: 'into-one-file',
  enforce: 'post',
  generateBundle(_, bundle) {
    const page = bundle['page.html'];
    if (page?.type !== 'asset') throw new Error('there is no page.html in the build');
    let script = '';
    let style = '';
    for (const [name, file] of Object.entries(bundle)) {
      if (file === page) continue;
      if (file.type === 'chunk') script += file.code;
      else if (name.endsWith('.css')) style += file.source;
      else throw new Error(`${name} would be a second file`);
      delete bundle[name];
    }
    script = script.replaceAll('</script', '<\\/script');
    const allowed = (text: string) => `'sha256-${createHash('sha256').update(text).digest('base64')}'`;
    const policy = `default-src 'none'; script-src ${allowed(script)}; style-src ${allowed(style)}; img-src data:`;
    const html = String(page.source)
      .replace(/<script type="module"[^>]*><\/script>/, () => `<script type="module">${script}</script>`)
      .replace(/<link rel="stylesheet"[^>]*>/, () => `<style>${style}</style>`)
      .replace('<meta charset="utf-8" />', (charset) => `${charset}\n    <meta http-equiv="Content-Security-Policy" content="${policy}" />`);
    if (!html.includes(script) || !html.includes(style) || !html.includes(policy)) throw new Error('script, style or policy has no place in page.html');
    page.source = html;
  },
};

// The page of `drgs export ASSET page.html`: Python puts the object into it.
export default defineConfig({
  base: './',
  publicDir: false,
  oxc: { jsx: { runtime: 'automatic', importSource: 'preact' } },
  plugins: [intoOneFile],
  build: {
    outDir: '../drgs/convert/page',
    emptyOutDir: false, // it holds the Python beside it
    target: 'es2022',
    modulePreload: { polyfill: false },
    rolldownOptions: { input: 'page.html', output: { codeSplitting: false } },
  },
});

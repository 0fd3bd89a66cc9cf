import { fileURLToPath } from 'node:url';
import { defineConfig, type Plugin } from 'vite';

// `npm run dev` proxies to a running `drgs serve`; the build is what that server hands out.
const server = 'http://127.0.0.1:8000';

const SPLAT_TRANSFORM = /splat-transform[\\/]dist[\\/]index\.mjs(\?|$)/;
/** splat-transform as the browser needs it: without its engine, without Node's modules, and with no other files of its package but the one that is asked for. */
const splatTransform: Plugin = {
  name: 'splat-transform',
  enforce: 'pre',
  resolveId(id, importer) {
    if (!importer || !SPLAT_TRANSFORM.test(importer)) return null;
    if (id === 'playcanvas') return fileURLToPath(new URL('./src/ui/export/splats/engine.ts', import.meta.url));
    return id.startsWith('node:') ? '\0not-in-browsers' : null;
  },
  load: (id) => (id === '\0not-in-browsers' ? 'export {};' : null),
  // Where the package lies is asked only for files whose addresses it is given; Vite would take all that lie beside it.
  transform: (code, id) => (SPLAT_TRANSFORM.test(id) ? code.replaceAll('import.meta.url', 'self.location.href') : null),
};

export default defineConfig({
  base: '/',
  plugins: [splatTransform],
  worker: { format: 'es', plugins: () => [splatTransform], rolldownOptions: { output: { codeSplitting: false } } },
  oxc: { jsx: { runtime: 'automatic', importSource: 'preact' } },
  build: {
    outDir: '../server/drgs_server/static',
    emptyOutDir: true,
    target: 'es2022',
    assetsInlineLimit: 0, // the server's content policy allows no inline script or style
    chunkSizeWarningLimit: 1000,
    modulePreload: { polyfill: false }, // the polyfill would be an inline script
    rolldownOptions: {
      checks: { bundlerTimings: false }, // splat-transform is large to read, which nobody needs to be told at each build
      output: { codeSplitting: { groups: [{ name: 'three', test: /node_modules[\\/](three|camera-controls)/ }] } },
    },
  },
  optimizeDeps: { exclude: ['@playcanvas/splat-transform'] }, // `npm run dev` would bundle it by other rules
  server: { proxy: { '/api': { target: server, ws: true } } },
});

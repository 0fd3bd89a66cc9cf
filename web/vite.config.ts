import { defineConfig } from 'vite';

// `npm run dev` proxies to a running `drgs serve`; the build is what that server hands out.
const server = 'http://127.0.0.1:8000';

export default defineConfig({
  base: '/',
  oxc: { jsx: { runtime: 'automatic', importSource: 'preact' } },
  build: {
    outDir: '../server/drgs_server/static',
    emptyOutDir: true,
    target: 'es2022',
    assetsInlineLimit: 0, // the server's content policy allows no inline script or style
    chunkSizeWarningLimit: 1000,
    modulePreload: { polyfill: false }, // the polyfill would be an inline script
    rolldownOptions: {
      output: { codeSplitting: { groups: [{ name: 'three', test: /node_modules[\\/](three|camera-controls)/ }] } },
    },
  },
  server: { proxy: { '/api': { target: server, ws: true } } },
});

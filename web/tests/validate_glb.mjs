// What Khronos' validator says of GLB files: `node validate_glb.mjs FILE ...` prints a JSON list, one list of messages a file.

import { readFile } from 'node:fs/promises';
import { validateBytes } from 'gltf-validator';

const reports = await Promise.all(
  process.argv.slice(2).map(async (path) => validateBytes(new Uint8Array(await readFile(path)), { format: 'glb', maxIssues: 0 })),
);
console.log(JSON.stringify(reports.map((report) => report.issues.messages)));

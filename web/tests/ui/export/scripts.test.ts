import { expect, it } from 'vitest';
import { asCurl, asPython } from '../../../src/ui/export/scripts';

it('scripts hold edits in their own language', () => {
  const scene = { origin: 'http://127.0.0.1:8000', asset: 'a1', session: 's1', edits: [{ op: 'material' as const, select: { all: true, region: null }, set: { metallic: 1 } }], view: null, settings: { spp_target: 64 } };
  expect(asPython(scene)).toContain('session.edit({"op": "material", "select": {"all": True}, "set": {"metallic": 1}})');
  expect(asCurl(scene)).toContain("'http://127.0.0.1:8000/api/sessions/s1/frame.png'");
});

/** What the object may be made of, side by side. */

import { addVariant, applyVariant, AS_CAPTURED, removeVariant, renameVariant, variants, variantShown, variantThumbnails } from '../../edit/material/variants';
import { Entry, Section } from '../fields';
import { Icon } from '../icons';

/** Characters of a name. */
const LONGEST_NAME = 100;

export function Variants() {
  const kept = variants.value;
  const thumbnail = (i: number) => (variantThumbnails.value[i] ? <img src={variantThumbnails.value[i]} alt="" /> : <span class="no-thumbnail" aria-hidden="true" />);
  const apply = (name: string, label: string) => (
    <button aria-label={`Apply ${label}`} aria-pressed={variantShown.value === name} title="Put it in the place of the material edits in force" onClick={() => applyVariant(name)}>
      Apply
    </button>
  );
  return (
    <Section title="Variants">
      {kept.length === 0 ? (
        <p class="hint">Keep what the object is made of now, make it of something else, and change between the two. A GLB of this session holds all variants.</p>
      ) : (
        <ul class="variants">
          <li>
            {thumbnail(0)}
            <span class="name">{AS_CAPTURED}</span>
            {apply(AS_CAPTURED, 'captured materials')}
          </li>
          {kept.map(({ name }, i) => (
            <li key={name}>
              {thumbnail(i + 1)}
              <Entry type="text" class="name" aria-label={`Name of ${name}`} title={name} value={name} maxLength={LONGEST_NAME} spellcheck={false} onEnter={(text) => renameVariant(name, text)} />
              {apply(name, name)}
              <button class="ghost forget" aria-label={`Remove ${name}`} title="Remove" onClick={() => removeVariant(name)}>
                <Icon name="close" />
              </button>
            </li>
          ))}
        </ul>
      )}
      <div class="buttons">
        <button disabled={variantShown.value !== null} title="Keep the material edits in force under a name; there are none where the object is as captured" onClick={addVariant}>Add what is shown</button>
      </div>
    </Section>
  );
}

/** What the doctor says of a capture, in its own words. */

import type { CaptureReport } from '../../session/protocol.gen';

const LEVEL_TEXT = { error: 'Error', warning: 'Warning', info: 'Note' };
const counted = (count: number, word: string) => (count > 0 ? [`${count} ${word}${count > 1 ? 's' : ''}`] : []);

/** What the doctor says of the capture. `said`: what stands above already. */
export function Findings({ report, said, open }: { report: CaptureReport; said: string | null; open: boolean }) {
  const { summary, findings } = report;
  const warnings = findings.filter((finding) => finding.level === 'warning').length;
  const counts = [...counted(warnings, 'warning'), ...counted(findings.length - warnings, 'note')].join(', ');
  const list = (
    <ul>
      {findings.map(({ level, sentence, advice }) => (
        <li class={level}>
          {sentence !== said && (
            <p>
              <strong>{LEVEL_TEXT[level]}:</strong> {sentence}
            </p>
          )}
          {advice && <p class="hint">{advice}</p>}
        </li>
      ))}
    </ul>
  );
  return (
    <div class="findings">
      {summary && <p class="facts">{summary}</p>}
      {findings.length === 0 ? (
        <p class="facts good">Nothing about this capture stands in the way.</p>
      ) : isUnreadable(report) ? (
        list
      ) : (
        <details class="fold" open={open && warnings > 0}>
          <summary>The capture: {counts}</summary>
          {list}
        </details>
      )}
    </div>
  );
}

export const isUnreadable = (report: CaptureReport | null) => report?.findings.some((finding) => finding.level === 'error') ?? false;

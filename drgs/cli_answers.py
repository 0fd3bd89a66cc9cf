"""What commands say on stdout of what they found: one JSON document, or lines for readers."""

import json
from typing import Any


def print_document(document: dict[str, Any], as_json: bool) -> None:
    """One JSON document, or the same as lines 'name value'."""
    if as_json:
        print(json.dumps(document))
        return

    def show(value: Any, name: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                show(inner, f"{name}.{key}" if name else str(key))
        else:
            print(f"{name:40s} {value:.4f}" if isinstance(value, float) else f"{name:40s} {value}")

    show(document, "")


def print_report(report: dict[str, Any]) -> None:
    """The doctor's report on a capture that can be built: its numbers, then what it found and advises."""
    print_document({name: value for name, value in report.items() if name not in ("findings", "advice", "summary", "marks")}, as_json=False)
    for line in [f"{finding['level']}: {finding['sentence']}" for finding in report["findings"]] + report["advice"]:
        print(line)
    if not report["findings"]:
        print("Nothing was found that would hurt a build.")


def print_skipped(frames: list[dict[str, Any]]) -> None:
    """What was left out of the work for each picture, and all else that is known of it."""
    for frame in frames:
        for left_out in frame["skipped"]:
            print(f"{frame['name']}: left out {left_out['what']}: {left_out['why']} ({left_out['bound']})")
        print(json.dumps(frame, indent=1))

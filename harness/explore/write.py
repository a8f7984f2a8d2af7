"""The smallest run as a scenario file: short, read by people, and played again by `ucp-harness run`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from harness.archive.directory import default_path
from harness.checker.judgement import Judgement
from harness.errors import MachineError, RunDirectoryError
from harness.explore.document import Document, at
from harness.explore.recording import Lost, Recording
from harness.scenario.verdicts import CHARACTERISTICS

EVIDENCE_SHOWN = 5
ORDER = (
    "name",
    "agents",
    "duration_s",
    "network",
    "clocks",
    "settings",
    "quirks",
    "timeline",
    "schedule",
    "events",
    "fates",
    "settle",
    "final_reconcile",
)


def claim(out: Path | None, name: str) -> Path:
    """Where the file will be: `out`, or a new name under `runs`. Raises RunDirectoryError if there is one already."""
    if out is not None and out.exists():
        raise RunDirectoryError(f"{out} exists: choose another --out, nothing is overwritten")
    path = out or default_path(f"{name} shrunk").with_suffix(".yaml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunDirectoryError(f"{path.parent} cannot be made: {error.strerror}; choose another --out") from None
    return path


def write(path: Path, text: str) -> Path:
    """Where it was written: a number is added if somebody was faster. Raises MachineError."""
    free, number = path, 2
    while True:
        try:
            with free.open("x", encoding="utf-8") as file:
                file.write(text)
            return free
        except FileExistsError:
            free, number = path.with_stem(f"{path.stem}-{number}"), number + 1
        except OSError as error:
            raise MachineError(f"{free} cannot be written: {error.strerror}") from None


def to_yaml(document: Document, header: list[str], recording: Recording) -> str:
    """`recording` of this very document says when each message was sent that a fate is about."""
    sent = {(lost.message, lost.sender, lost.receiver, lost.count): lost for lost in recording.lost}
    lines = [f"# {line}".rstrip() for line in header]
    if at(document, "settings.max_block_bytes") is not None:
        lines.append("# Blocks are full as soon as another event of the largest size might not fit: here, after one.")
    for key in ORDER:
        if key in document:
            lines += _lines(key, _plain(document[key]), sent)
    return "\n".join(lines) + "\n"


def evidence_lines(violated: dict[str, Judgement]) -> list[str]:
    """What is violated, and how one sees it."""
    lines = []
    for key, judgement in violated.items():
        if key in CHARACTERISTICS:
            lines.append(f"Characteristic {key}, {judgement.name}, is violated, {judgement.reason}")
        else:
            lines.append(f"{judgement.name.capitalize()}: {judgement.verdict}, {judgement.reason}")
        lines += [f"  agent {finding.agent_id}: {finding.detail}" for finding in judgement.evidence[:EVIDENCE_SHOWN]]
        if len(judgement.evidence) > EVIDENCE_SHOWN:
            lines.append(f"  and {len(judgement.evidence) - EVIDENCE_SHOWN} more")
    return lines


def _lines(key: str, value: Any, sent: dict[Any, Lost]) -> Iterator[str]:
    """One line for a key, or one for each of a list of mappings."""
    if key == "events" and "script" in value:
        yield "events:"
        yield f"  source: {value['source']}"
        yield "  script:"
        yield from (f"    - {_flow(event)}" for event in value["script"])
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        yield f"{key}:"
        for entry in value:
            lost = sent.get(
                (entry.get("message"), entry.get("sender"), entry.get("receiver"), _hashable(entry.get("count")))
            )
            about = f", block {lost.block}" if lost and lost.block else ""
            yield f"  - {_flow(entry)}" + (f"  # sent at {lost.at_s:.3f} s{about}" if lost else "")
    else:
        yield f"{key}: {_flow(value)}"


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _flow(value: Any) -> str:
    written: str = yaml.safe_dump([value], default_flow_style=True, sort_keys=False, width=1e9, allow_unicode=True)
    return written.strip()[1:-1]


def _plain(value: Any) -> Any:
    """Whole numbers without a point; agents that are keys as numbers."""
    if isinstance(value, dict):
        return {int(key) if key.isdecimal() else key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value

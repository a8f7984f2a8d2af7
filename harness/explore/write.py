"""The smallest run as a scenario file: short, read by people, and played again by `ucp-harness run`."""

from pathlib import Path
from typing import Any

from harness.archive.directory import default_path
from harness.checker.judgement import Judgement
from harness.errors import MachineError, RunDirectoryError
from harness.explore.document import Document, at
from harness.explore.recording import Lost, Recording
from harness.scenario.verdicts import CHARACTERISTICS
from harness.scenario.write import to_yaml

EVIDENCE_SHOWN = 5


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


def file_of(document: Document, header: list[str], recording: Recording) -> str:
    """`recording` of this very document says when each message was sent that a fate is about."""
    sent: dict[Any, Lost] = {(lost.message, lost.sender, lost.receiver, lost.count): lost for lost in recording.lost}

    def remark(entry: Document) -> str | None:
        key = entry.get("message"), entry.get("sender"), entry.get("receiver"), _hashable(entry.get("count"))
        if (lost := sent.get(key)) is None:
            return None
        return f"sent at {lost.at_s:.3f} s" + (f", block {lost.block}" if lost.block else "")

    comment = [*header]
    if at(document, "settings.max_block_bytes") is not None:
        comment.append("Blocks are full as soon as another event of the largest size might not fit: here, after one.")
    return to_yaml(document, comment, remark)


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


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value

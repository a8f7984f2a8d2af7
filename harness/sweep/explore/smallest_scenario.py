"""The smallest run as a scenario file: short, read by people, and played again by `ucp-harness run`."""

from typing import Any

from harness.scenario.scenario_file import to_yaml
from harness.sweep.explore.recording import Lost, Recording
from harness.sweep.explore.scenario_document import Document, at


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


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value

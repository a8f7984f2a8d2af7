"""The losses on a shared channel, as `channel.jsonl` of a run has them."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from harness.archive.directory import CHANNEL_FILE
from harness.archive.packets.capture_reader import ListenerName
from harness.archive.packets.transmissions import Transmission

ChannelLosses = Mapping[tuple[int, int], Mapping[str, list[int]]]
"""(sender, sequence number) -> reason -> vehicles. A reason in DROPS has no vehicles."""

DROPS = ("queue", "too_long")
"""Reasons for which a radio does not send a message."""

MAX_LINE = 100_000
Reason = Annotated[str, Field(max_length=20)]


class _Line(BaseModel):
    model_config = ConfigDict(strict=True)

    sender: int
    sequence: int | None
    lost: dict[Reason, list[int]] = {}
    dropped: Reason | None = None


def channel_losses(runs: Iterable[Path]) -> ChannelLosses:
    """Return the losses of these run directories. Lines that cannot be read have no effect."""
    losses: dict[tuple[int, int], dict[str, list[int]]] = {}
    for run in runs:
        try:
            with (run / CHANNEL_FILE).open(encoding="utf-8", errors="replace") as file:
                while text := file.readline(MAX_LINE):
                    _take(losses, text)
        except OSError:
            continue
    return losses


def loss_reasons(losses: ChannelLosses, transmission: Transmission) -> dict[str, list[ListenerName]]:
    """Return the vehicles that lost the message on the channel, by reason. All vehicles lose a dropped message."""
    named = {
        reason: [name for name in transmission.lost_by if reason in DROPS or name in vehicles]
        for reason, vehicles in losses.get((transmission.sender, transmission.sequence), {}).items()
    }
    return {reason: names for reason, names in named.items() if names}


def _take(losses: dict[tuple[int, int], dict[str, list[int]]], text: str) -> None:
    try:
        line = _Line.model_validate(json.loads(text))
    except (ValueError, ValidationError, RecursionError):
        return
    if line.sequence is not None:
        losses[line.sender, line.sequence] = {line.dropped: []} if line.dropped else line.lost

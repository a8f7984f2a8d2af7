"""Read the losses on a shared radio channel from `channel.jsonl`."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from harness.archive.bounded_file import JsonLines
from harness.archive.channel_journal import CHANNEL_FILE, ChannelLine
from harness.archive.packets.capture_reader import ListenerName
from harness.archive.packets.transmissions import Transmission

ChannelLosses = Mapping[tuple[int, int], Mapping[str, list[int]]]
"""(Sender, sequence number) -> reason -> vehicles that did not receive the message for this reason. The set is empty
for the reasons in DROPS.
"""

DROPS = ("queue", "too_long")
"""Reasons for which a radio does not send a message."""


def channel_losses(runs: Iterable[Path]) -> ChannelLosses:
    """Return the losses recorded in these run directories. Unreadable lines are ignored."""
    return {
        (line.sender, line.sequence): {line.dropped: []} if line.dropped else line.lost
        for run in runs
        for line in JsonLines(run / CHANNEL_FILE, ChannelLine)
        if line.sequence is not None
    }


def loss_reasons(losses: ChannelLosses, transmission: Transmission) -> dict[str, list[ListenerName]]:
    """Return, for each reason, the vehicles that did not receive the message on the channel. If the radio of the sender
    dropped the message, no vehicle received it.
    """
    named = {
        reason: [name for name in transmission.lost_by if reason in DROPS or name in vehicles]
        for reason, vehicles in losses.get((transmission.sender, transmission.sequence), {}).items()
    }
    return {reason: names for reason, names in named.items() if names}

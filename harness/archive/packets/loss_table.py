"""What was lost between each two: counted per directed pair, as the radio loses it."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from harness.archive.packets.capture_reader import Name
from harness.archive.packets.transmissions import Transmission


class Pair(NamedTuple):
    """Of `sent` datagrams that the receiver should have heard, `lost` never reached it."""

    sender: int
    receiver: Name
    sent: int
    lost: int


def count_losses(transmissions: Iterable[Transmission]) -> list[Pair]:
    """All pairs, by sender and receiver. What somebody forged is no agent's loss."""
    sent: dict[tuple[int, Name], int] = {}
    lost: dict[tuple[int, Name], int] = {}
    for transmission in transmissions:
        if transmission.origin == "forged":
            continue
        for receiver in (*transmission.reached, *transmission.lost_by):
            sent[transmission.sender, receiver] = sent.get((transmission.sender, receiver), 0) + 1
        for receiver in transmission.lost_by:
            lost[transmission.sender, receiver] = lost.get((transmission.sender, receiver), 0) + 1
    pairs = (
        Pair(sender, receiver, count, lost.get((sender, receiver), 0)) for (sender, receiver), count in sent.items()
    )
    return sorted(pairs, key=lambda pair: (pair.sender, isinstance(pair.receiver, str), pair.receiver))


def matrix(pairs: list[Pair]) -> Iterator[str]:
    """A row for each sender, a column for each receiver: lost/sent."""
    receivers = sorted({pair.receiver for pair in pairs}, key=lambda name: (isinstance(name, str), name))
    cells = {(pair.sender, pair.receiver): f"{pair.lost}/{pair.sent}" for pair in pairs}
    width = max(map(len, [*cells.values(), *map(str, receivers)]), default=0)
    yield "lost/sent, from (down) to (across)"
    yield " ".join([" " * 6, *(f"{receiver:>{width}}" for receiver in receivers)])
    for sender in sorted({pair.sender for pair in pairs}):
        yield " ".join([f"{sender:>6}", *(f"{cells.get((sender, receiver), '-'):>{width}}" for receiver in receivers)])

"""Find the same packets in all captures, and combine them into messages with their receivers.

A datagram is identified by its bytes. An agent that was restarted may send the same bytes again. Each reception
therefore belongs to the latest earlier transmission of the datagram. If a complete capture of the sender does not
contain the transmission, the datagram is forged.

`channel_losses` reads the losses on a shared radio channel from `channel.jsonl`.
"""

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from harness.archive.bounded_file import JsonLines
from harness.archive.packets.capture_files import CaptureClock, Captures
from harness.archive.packets.capture_reader import Capture, Datagram, ListenerName, MessageSummary
from harness.archive.packets.pcap import OUTBOUND
from harness.archive.run_journals import CHANNEL_FILE, ChannelLine

Origin = Literal["captured", "inferred", "forged"]
"""The origin of a transmission. `captured` means that the capture of the sender contains the transmission. `inferred`
means that the sender captured no packets at that time, so `at_s` is the time of the first reception. `forged` means
that the datagram names a sender that did not send it.
"""


class DatagramReception(NamedTuple):
    """The reception of a datagram at one vehicle: the number of copies, and the mission seconds of the first and the
    last copy.
    """

    by: ListenerName
    at_s: float
    copies: int = 1
    last_s: float = 0.0


class Transmission(NamedTuple):
    """A datagram that was sent once, at mission second `at_s`. `number` is its position in the order of sending,
    counted from 0.

    A listener is a captured vehicle or a separate observer. `seen_leaving` is the listener whose capture shows that the
    datagram was sent. The listeners in `lost_by` captured at that time but did not receive the datagram. The listeners
    in `absent` did not capture at that time, so their reception is unknown.
    """

    number: int
    at_s: float
    sender: int
    sequence: int
    summary: MessageSummary
    origin: Origin
    seen_leaving: ListenerName | None
    received: tuple[DatagramReception, ...]
    lost_by: tuple[ListenerName, ...]
    absent: tuple[ListenerName, ...]

    @property
    def reached(self) -> list[ListenerName]:
        return [reception.by for reception in self.received]

    def for_receiver(self, receiver: ListenerName) -> "Transmission":
        """Return a copy of this transmission in which `receiver` is the only receiver."""
        return self._replace(
            received=tuple(reception for reception in self.received if reception.by == receiver),
            lost_by=tuple(name for name in self.lost_by if name == receiver),
            absent=tuple(name for name in self.absent if name == receiver),
        )


class _Listeners:
    """The captured vehicles and other observers, each with its packet captures."""

    def __init__(self, captures: Iterable[Capture]) -> None:
        self._transmissions: dict[ListenerName, list[Capture]] = {}
        for capture in captures:
            self._transmissions.setdefault(capture.name, []).append(capture)
        self.names = sorted(self._transmissions, key=lambda name: (isinstance(name, str), name))

    def listening(self, name: ListenerName, time_ns: int) -> bool:
        return any(capture.listening(time_ns) for capture in self._transmissions.get(name, ()))

    def would_record_sending(self, sender: ListenerName, time_ns: int) -> bool:
        """Return true if the captures of the sender must contain each datagram that the sender sent at this time. This
        is not certain if the captures contain only received datagrams, or lack frames.
        """
        captures = self._transmissions.get(sender, ())
        sound = any(capture.sees_itself for capture in captures) and not any(capture.dropped for capture in captures)
        return sound and self.listening(sender, time_ns)


def join(captures: Captures) -> list[Transmission]:
    """Combine the datagrams of all captures, and return each transmission once, in the order of sending."""
    by_number = {capture.number: capture for capture in captures.used}
    listeners = _Listeners(captures.used)
    transmissions = [
        transmission
        for datagram in captures.datagrams
        for transmission in _transmissions(datagram, by_number, listeners, captures.clock)
    ]
    transmissions.sort(key=lambda transmission: (transmission.at_s, transmission.sender, transmission.sequence))
    return [transmission._replace(number=number) for number, transmission in enumerate(transmissions)]


def _transmissions(
    datagram: Datagram, captures: Mapping[int, Capture], listeners: _Listeners, clock: CaptureClock
) -> Iterator[Transmission]:
    """Yield one transmission for each time that the datagram was sent."""
    left: list[tuple[int, ListenerName]] = []
    arrived: list[tuple[int, ListenerName]] = []
    for time_ns, number, direction in sorted(datagram.sightings()):
        if capture := captures.get(number):
            leaving = capture.direction(datagram.sender, direction) == OUTBOUND
            (left if leaving else arrived).append((time_ns, capture.name))
    times = [time_ns for time_ns, _ in left or arrived[:1]]
    arrivals: list[dict[ListenerName, list[int]]] = [{} for _ in times]
    for time_ns, name in arrived:
        arrivals[max(0, bisect_right(times, time_ns) - 1)].setdefault(name, []).append(time_ns)
    for index, (time_ns, reached) in enumerate(zip(times, arrivals, strict=True)):
        seen_leaving = left[index][1] if left else None
        missing = [
            name for name in listeners.names if name not in reached and name not in (datagram.sender, seen_leaving)
        ]
        yield Transmission(
            number=0,
            at_s=clock.seconds(time_ns),
            sender=datagram.sender,
            sequence=datagram.sequence,
            summary=datagram.summary,
            origin=_origin(datagram.sender, seen_leaving, listeners.would_record_sending(datagram.sender, time_ns)),
            seen_leaving=seen_leaving,
            received=tuple(
                DatagramReception(
                    name, clock.seconds(reached[name][0]), len(reached[name]), clock.seconds(reached[name][-1])
                )
                for name in listeners.names
                if name in reached
            ),
            lost_by=tuple(name for name in missing if listeners.listening(name, time_ns)),
            absent=tuple(name for name in missing if not listeners.listening(name, time_ns)),
        )


def _origin(sender: int, seen_leaving: ListenerName | None, would_have_been_seen: bool) -> Origin:
    if seen_leaving == sender:
        return "captured"
    return "forged" if seen_leaving is not None or would_have_been_seen else "inferred"


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

"""Find messages that reached the vehicle of an agent but are missing in its trace.

An agent writes a line for each message that it handles or drops. A capture of its vehicle contains the messages that
arrived. If a few messages have no line, this proves nothing, because lines may be lost, or the socket of the agent may
discard messages. If messages at many separate places have no line, this is a deviation. Only messages that would have
had an effect count, because simulated agents do not receive others.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Protocol

from harness.checker.recorded_inputs import decoded
from harness.checker.steps.deviation import StepDeviation
from harness.field._vehicle_captures import CapturedDatagram
from harness.field.replay._agent_record import RecordedTrace, RecordEntry
from ucp.messages import MalformedDatagramError, Message, decode
from ucp.trace import CommandEntry, DroppedDatagram, HandlerRun
from ucp.trigger import MessageTrigger

MAX_PLACES = 3
"""Maximum number of places at which messages may lack a trace line. If there are more such places, lost lines and a
full socket are no sufficient explanation.
"""
MAX_CLOCK_STEP_S = 1.0
"""Maximum change of the difference between the clocks of trace and capture from one common message to the next, in
mission seconds. After a larger change, the position of a message between the two is not known.
"""
MAX_TRIED = 200
"""Maximum number of messages without a line for which the effect is computed."""


class PlayedAgent(Protocol):
    """A replayed agent, at some position in its record."""

    @property
    def lost(self) -> str | None: ...

    def has_effect(self, sender: int, message: Message, at_s: float) -> bool: ...

    def handler_of(self, message: Message) -> str: ...


def ignored_messages(record: RecordedTrace, play_to: Callable[[int], PlayedAgent]) -> tuple[int, StepDeviation] | None:
    """Return the first message that the agent ignored, with its position. Return None if the agent ignored only a few
    messages or none.

    `play_to` plays the entries up to a position.
    """
    places: list[tuple[int, CapturedDatagram, Message]] = []
    last = -1
    for position, sighting in _without_line(record):
        message = decode(sighting.datagram).message
        player = play_to(position)
        if player.lost is not None or record.entries[position].gap is not None:
            continue
        if position != last and player.has_effect(sighting.sender, message, sighting.at_s):
            places.append((position, sighting, message))
            last = position
    if len(places) <= MAX_PLACES:
        return None
    position, sighting, message = places[0]
    entry = record.entries[position]
    handler = play_to(position).handler_of(message)
    what = (
        f"it did not run for the {message.NAME} {sighting.sequence} of agent {sighting.sender}, which reached its "
        f"vehicle at t={sighting.at_s:g} s; messages that reached the vehicle are missing at {len(places)} places, so "
        "the agent ignored them, or its socket discarded them"
    )
    return position, StepDeviation(record.agent_id, entry.line, sighting.at_s, handler, what)


def _without_line(record: RecordedTrace) -> Iterator[tuple[int, CapturedDatagram]]:
    """Yield the messages that arrived at the agent but that its trace does not contain. Yield each message with the
    position of the trace entry that follows the arrival. Messages before the first entry or after the last entry of an
    incarnation are skipped.

    The messages that both files contain show the difference between the clock of the trace and the clock of the
    capture. If this difference changes around a message, one clock was set. This message is skipped, because its
    position in the trace is not known.
    """
    arrivals = record.arrivals or []
    times = [entry.content.t for entry in record.entries]
    lines: dict[tuple[int, int], list[int]] = {}
    for position, entry in enumerate(record.entries):
        if (trigger := _received(entry)) is not None:
            lines.setdefault((trigger.sender, trigger.sequence), []).append(position)
    with_line: list[tuple[float, int]] = []
    for seen in arrivals:  # a restarted sender uses its sequence numbers again
        if candidates := lines.get((seen.sender, seen.sequence)):
            nearest = min((abs(times[position] - seen.at_s), position) for position in candidates)[1]
            with_line.append((seen.at_s, nearest))
    captured = [at_s for at_s, _ in with_line]
    tried = 0
    for sighting in arrivals:
        if (sighting.sender, sighting.sequence) in lines or sighting.sender not in record.header.roster:
            continue
        later = bisect_right(captured, sighting.at_s)
        around = [(times[line] - at_s, line) for at_s, line in with_line[max(later - 1, 0) : later + 1]]
        offsets = [offset_s for offset_s, _ in around] or [0.0]
        start = around[0][1] if later else 0
        end = around[-1][1] if later < len(with_line) else len(times)
        if max(offsets) - min(offsets) > MAX_CLOCK_STEP_S or start > end:
            continue
        position = bisect_right(times, sighting.at_s + offsets[0], start, end)
        if not 0 < position < len(times) or tried == MAX_TRIED:
            continue
        if record.entries[position - 1].incarnation == record.entries[position].incarnation:
            tried += 1
            yield position, replace(sighting, at_s=sighting.at_s + offsets[0])


def _received(entry: RecordEntry) -> MessageTrigger | None:
    match entry.content:
        case HandlerRun(trigger=MessageTrigger() as trigger):
            return trigger
        case DroppedDatagram() as dropped:
            with suppress(MalformedDatagramError):
                sender, sequence, message = decoded(dropped.datagram)
                return MessageTrigger(message.NAME, sender, sequence)
        case HandlerRun() | CommandEntry():
            pass
    return None

"""Simulate a shared radio channel in a process of its own: `python -m harness.play.process._channel_node`.

The process takes over the broadcasts of all vehicles from the switch (`netem.relay`), and delivers them when
`LiveChannel` decides. The process runs in the run directory. In this directory it creates the socket `channel.control`,
which accepts the commands below, and the journal `channel.jsonl`. Large values of commands are passed in files, because
the length of a line on a control socket is limited. SIGTERM ends the process.

The process waits with `select`, whose timeouts are exact to microseconds. It measures how late each delivery is.
"""

import contextlib
import dataclasses
import json
import os
import resource
import selectors
import signal
import sys
import time
from array import array
from pathlib import Path
from typing import Any

from harness.play._shared_channel import LOAD_S, NEVER
from harness.play.process._live_channel import LiveChannel
from netem.channel import PRESETS
from netem.conditions import NetworkConditions
from netem.errors import NetemError
from netem.radio import Place
from netem.relay import ReceivedBroadcast, Relay
from ucp.clock import MissionClock
from ucp.control import Command, CommandError, ControlServer
from ucp.loop import Loop, ScheduledCall
from ucp.messages import (
    HEADER,
    MAGIC,
    TYPE_CODES,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    NextInSequenceResponse,
    RequestForBlock,
)

CONTROL = "channel.control"
VALUE = "channel.value"
"""Name of the file through which large values of commands and answers are passed. A line on the control socket would be
too short.
"""

NANOSECONDS = 1e9
KEPT_QUESTIONS = 10_000
TYPE_AT = 3
"""Position of the type code in a datagram, in bytes."""
ANSWER_TO = {
    TYPE_CODES[question]: TYPE_CODES[answer]
    for question, answer in (
        (BlockAddRequest, BlockAddResponse),
        (ChainContainQuery, ChainContainResponse),
        (ChainHashSuccessorQuery, NextInSequenceResponse),
        (RequestForBlock, BlockResponse),
    )
}
"""Type code of a query or request -> type code of the answers to it."""


class ChannelNode:
    """The process that simulates the radio channel. The process writes its log to `journal`. Raises OSError if the
    process may not read packets.
    """

    def __init__(self, directory: Path, journal: Path, port: int) -> None:
        self._directory = directory
        self._port = port
        self._clock = MissionClock(1.0)
        self._channel: LiveChannel | None = None
        self._relay: Relay | None = None
        self._roster: tuple[int, ...] = ()
        self._lateness = DeliveryLateness()
        self._answers = AnswerTimeMeter()
        self._timer: ScheduledCall | None = None
        self._loop = Loop(selector=selectors.SelectSelector())
        self._journal = journal.open("a", encoding="utf-8")
        commands: dict[str, Command] = {
            "status": dict,
            "start": self._start,
            "move": self._move,
            "apply": self._apply,
            "clear": self._clear,
            "totals": self._totals,
        }
        self._control = ControlServer(directory / CONTROL, commands, self._loop)

    def run(self) -> None:
        """Run until the process receives SIGTERM or SIGINT."""
        self._loop.stop_on(signal.SIGTERM, signal.SIGINT)
        self._control.start()
        self._loop.run()
        self._journal.close()
        self._control.close()
        self._loop.close()

    def _process_broadcasts(self) -> None:
        """Read the waiting broadcasts and deliver the frames that are due. Then set a timer for the next event."""
        channel, relay, clock = self._channel, self._relay, self._clock
        if channel is None or relay is None:
            return
        now, now_ns = clock.now(), time.monotonic_ns()
        for heard in relay.take():
            if heard.vehicle not in self._roster:
                self._deliver_to_all(relay, heard)
                continue
            self._take(channel, heard, max(0.0, now - (now_ns - heard.at_ns) / NANOSECONDS * clock.speedup))
        for at_s, _, vehicle, frame in channel.advance(now):
            try:
                relay.deliver(vehicle, frame)
            except OSError:
                self._lateness.unsent += 1
            delivered_s = clock.now()
            self._lateness.add(at_s, delivered_s)
            self._answers.delivered(frame, vehicle, delivered_s)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if (next_s := channel.next_s) != NEVER:
            self._timer = self._loop.call_later(clock.wall_s(next_s - clock.now()), self._process_broadcasts)

    def _take(self, channel: LiveChannel, heard: ReceivedBroadcast, at_s: float) -> None:
        data = heard.udp_data(self._port)
        if data is None:
            channel.pass_by(at_s, heard.vehicle, heard.frame)
        else:
            self._answers.sent(heard, data, at_s)
            channel.send(at_s, heard.vehicle, heard.frame, len(data), _sequence(data, heard.vehicle))

    def _deliver_to_all(self, relay: Relay, heard: ReceivedBroadcast) -> None:
        """Deliver a broadcast of the rogue node (a sender outside the swarm) immediately to all vehicles. This
        broadcast does not occupy the channel.
        """
        for vehicle in self._roster:
            relay.deliver(vehicle, heard.frame)

    def _write(self, line: dict[str, object]) -> None:
        self._journal.write(json.dumps(line, separators=(",", ":")) + "\n")

    # Commands of the control socket. Only the harness sends them.

    def _start(self, request: dict[str, Any]) -> dict[str, object]:
        self._roster = roster = tuple(request["roster"])
        radio = dataclasses.replace(PRESETS[request["preset"]], **request["figures"])
        self._channel = LiveChannel(roster, radio, request["processing_s"], request["seed"], self._write)
        self._clock = MissionClock(request["speedup"])
        self._clock.start(request["epoch_us"])
        try:
            self._relay = Relay(roster, request["others"])
            self._relay.open()
        except (OSError, NetemError) as error:
            raise CommandError(f"the kernel does not pass broadcasts to the shared channel: {error}") from None
        self._loop.watch(self._relay.input, readable=self._process_broadcasts)
        return {}

    def _move(self, request: dict[str, Any]) -> dict[str, object]:
        coordinates = iter(request["places"])
        places = [Place(*triple) for triple in zip(coordinates, coordinates, coordinates, strict=True)]
        if self._relay is not None:
            self._started().move(places, self._clock.now())
            self._process_broadcasts()
        return {}

    def _apply(self, request: dict[str, Any]) -> dict[str, object]:
        conditions = NetworkConditions.from_json(json.loads((self._directory / VALUE).read_text(encoding="utf-8")))
        if self._relay is not None:
            self._started().apply(conditions, self._clock.now())
            self._process_broadcasts()
        return {}

    def _clear(self, request: dict[str, Any]) -> dict[str, object]:
        """End the simulation of the channel. Messages on the channel are lost. From now on, the switch delivers all
        broadcasts.
        """
        if self._relay is not None:
            self._lateness.missed = self._relay.count_missed()
            self._loop.watch(self._relay.input)
            self._relay.close()
            self._relay = None
        return {}

    def _totals(self, request: dict[str, Any]) -> dict[str, object]:
        """Write the counts of the channel to a file. The harness copies them to `run.json`."""
        if self._relay is not None:
            self._lateness.missed = self._relay.count_missed()
        self._journal.flush()
        totals = {**self._started().totals.to_json(), **self._lateness.to_json(), **self._answers.to_json()}
        (self._directory / VALUE).write_text(json.dumps(totals), encoding="utf-8")
        return {}

    def _started(self) -> LiveChannel:
        if self._channel is None:
            raise CommandError("the channel has not started")
        return self._channel


class DeliveryLateness:
    """A record that shows how late the channel delivered frames, in mission seconds."""

    def __init__(self) -> None:
        self.missed = 0
        """Number of broadcasts that the process did not receive, because its buffer was full."""
        self.unsent = 0
        """Number of deliveries that the kernel did not accept."""
        self._all = array("f")
        self._most: list[float] = []
        """The greatest lateness of a delivery in each interval. The intervals are those of the load measurement
        (`LOAD_S`).
        """

    def add(self, due_s: float, now: float) -> None:
        """Record the lateness of a delivery that was due at `due_s` and happened at the time `now`."""
        late_s = max(0.0, now - due_s)
        self._all.append(late_s)
        index = int(due_s / LOAD_S)
        if len(self._most) <= index:
            self._most.extend([0.0] * (index + 1 - len(self._most)))
        self._most[index] = max(self._most[index], late_s)

    def to_json(self) -> dict[str, object]:
        used = resource.getrusage(resource.RUSAGE_SELF)
        ordered = sorted(self._all)
        return {
            "lateness": {
                "deliveries": len(ordered),
                **_quantiles(ordered),
                "most_s": round(ordered[-1], 6) if ordered else 0.0,
                "by_interval_s": [round(late_s, 4) for late_s in self._most],
                "missed": self.missed,
                "unsent": self.unsent,
                "processor_s": round(used.ru_utime + used.ru_stime, 3),
            }
        }


class AnswerTimeMeter:
    """A record of the times between the delivery of a query and the agent's answer, in mission seconds.

    In virtual time, an agent answers immediately, and passes the answer to its radio after `processing_s`. A real
    process first waits for a processor. If many agents share few processors, they answer one after another, so fewer
    answers collide.
    """

    def __init__(self) -> None:
        self._all = array("f")
        self._question: dict[bytes, int] = {}
        """Frame of a query -> type code of the answers to it. Only the latest queries are kept."""
        self._asked_s: dict[tuple[int, int], float] = {}
        """Vehicle and type code of an answer -> mission second at which the vehicle received the latest query that
        needs such an answer.
        """

    def sent(self, heard: ReceivedBroadcast, data: bytes, at_s: float) -> None:
        """Record that a vehicle sent this datagram at `at_s`."""
        code = data[TYPE_AT] if len(data) > TYPE_AT else None
        if code in ANSWER_TO:
            self._question[heard.frame] = ANSWER_TO[code]
            if len(self._question) > KEPT_QUESTIONS:
                del self._question[next(iter(self._question))]
        elif code is not None and (asked_s := self._asked_s.pop((heard.vehicle, code), None)) is not None:
            self._all.append(max(0.0, at_s - asked_s))

    def delivered(self, frame: bytes, vehicle: int, now: float) -> None:
        """Record that this frame was delivered to a vehicle."""
        answer = self._question.get(frame)
        if answer is not None:
            self._asked_s[vehicle, answer] = now

    def to_json(self) -> dict[str, object]:
        return {"answers": {"count": len(self._all), **_quantiles(sorted(self._all))}}


def _quantiles(ordered: list[float]) -> dict[str, float]:
    """Return the median and the 95 % quantile of the values, which are in ascending order. Return 0 for both if the
    sequence is empty.
    """
    count = len(ordered)
    shares = {"median_s": count // 2, "p95_s": count * 95 // 100}
    return {name: round(ordered[index], 6) if ordered else 0.0 for name, index in shares.items()}


def _sequence(data: bytes, vehicle: int) -> int | None:
    """Return the sequence number of a message. Return None if the data are not a message of the agent on this
    vehicle.
    """
    if len(data) < HEADER.size:
        return None
    magic, _, _, sender, sequence, _ = HEADER.unpack_from(data)
    return sequence if magic == MAGIC and sender == vehicle else None


def main() -> int:
    """Run the radio channel until it is stopped. Return the exit status: 0 after a stop, and 1 if the process has no
    access to the network.
    """
    with contextlib.suppress(OSError):  # an ordinary user may not run before all other programs
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(os.sched_get_priority_min(os.SCHED_RR)))
    try:
        ChannelNode(Path.cwd(), Path(sys.argv[1]), int(sys.argv[2])).run()
    except OSError as error:
        sys.stderr.write(f"the channel: {error.strerror}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

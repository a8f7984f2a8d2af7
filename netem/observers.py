"""Who looks at a study for `netem.measure`: real packets between the vehicles of a lab, or those of virtual time."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from netem import _probe
from netem.engine import Applied
from netem.errors import LabError
from netem.estimates import Heard, Lateness
from netem.lab import EngineName, Lab, LabProcess
from netem.measure import DATA_BYTES, REFERENCE, Observer, Study
from netem.medium import Medium

PAUSES_S = (0.005, 0.01, 0.02)
"""What a sender sleeps after every 20 packets: the first, if the machine can take it."""
SPACING_S = 0.0003
"""In virtual time, from one packet to the next."""

_PORT = 14600
_DEADLINE_S = 180.0  # of a stream
_QUIET_S = 0.5
_TRY_AGAIN = "this machine is too busy to measure just now: try again when it is idle"


def in_medium(seed: int) -> Observer:
    """An observer of `netem.medium`, where nothing is late; every stream is another, and all follow from the seed."""
    streams = itertools.count()

    def observe(study: Study, packets: int) -> Mapping[tuple[int, int], Heard]:
        medium = Medium(study.vehicles, seed << 32 | next(streams))
        medium.apply(study.conditions)
        sent_s = [number * SPACING_S for number in range(packets)]
        came: dict[tuple[int, int], list[tuple[float, int]]] = {
            (sender, receiver): [] for sender in study.senders for receiver in study.vehicles
        }
        for number, at_s in enumerate(sent_s):
            for sender in study.senders:
                for receiver, delay_s in medium.draw(study.vehicles.index(sender), at_s, DATA_BYTES).to_all():
                    came[sender, study.vehicles[receiver]].append((at_s + delay_s, number))
        never = Lateness([0.0] * packets, [0.0] * packets)
        return {
            link: Heard(sent_s, [(number, at_s) for at_s, number in sorted(arrivals)], never)
            for link, arrivals in came.items()
        }

    return observe


def in_lab(engine: EngineName) -> Observer:
    """An observer of real packets, in a lab of its own for every stream.

    Packets that the kernel's engine let pass and that nobody heard were lost by the machine itself: a receive buffer or
    the backlog of a processor was full. Such a stream says nothing of the engine and is sent again, slower. Raises
    LabError if that does not help, or if the lab fails; LabUnavailable if this machine has no such lab.
    """

    def observe(study: Study, packets: int) -> Mapping[tuple[int, int], Heard]:
        *quicker, slowest = PAUSES_S
        for pause_s in quicker:
            with contextlib.suppress(DisturbedError):
                return stream(study, packets, pause_s)
        return stream(study, packets, slowest)

    def stream(study: Study, packets: int, pause_s: float) -> Mapping[tuple[int, int], Heard]:
        try:
            return asyncio.run(asyncio.wait_for(_observe(engine, study, packets, pause_s), _DEADLINE_S))
        except TimeoutError:
            raise LabError(f"A stream of {packets} packets came to no end; {_TRY_AGAIN}") from None

    return observe


class DisturbedError(LabError):
    """The machine itself lost packets: what arrived says nothing of the engine."""


async def _observe(engine: EngineName, study: Study, packets: int, pause_s: float) -> dict[tuple[int, int], Heard]:
    vehicles = {*study.receivers, REFERENCE}
    numbers = {sender: range(i * packets, (i + 1) * packets) for i, sender in enumerate(study.senders)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        async with await Lab.open(study.vehicles, engine=engine, log=folder / "lab.log") as lab:
            await lab.apply(study.conditions)
            listeners = {vehicle: await _Program.start(lab, folder, vehicle, "receive", _PORT) for vehicle in vehicles}
            for listener in listeners.values():
                await listener.wait_for("ready")
            senders = {}
            for sender, own in numbers.items():
                stream = (_PORT, packets, own.start, lab.broadcast, DATA_BYTES, pause_s)
                senders[sender] = await _Program.start(lab, folder, sender, "broadcast", *stream)
            timers_s = {sender: (await program.end())["late_s"] for sender, program in senders.items()}
            counted = await _quiet(lab)
            reports = {vehicle: await listener.stop() for vehicle, listener in listeners.items()}
    came = {
        (sender, vehicle): _arrivals(reports[vehicle], own)
        for vehicle in vehicles
        for sender, own in numbers.items()
        if sender != vehicle  # whose own broadcasts come back to it at once
    }
    check(study, reports, came, counted)
    heard = {}
    for sender in study.senders:
        reference = sorted(came[sender, REFERENCE])
        sent_s, way_s = [packet.sent_s for packet in reference], [packet.at_s - packet.sent_s for packet in reference]
        if missing := packets - len(reference):
            raise DisturbedError(f"{missing} of {packets} packets were lost where nothing is asked; {_TRY_AGAIN}")
        for receiver in study.receivers:
            if receiver != sender:
                arrivals = [(packet.number, packet.at_s) for packet in came[sender, receiver]]
                heard[sender, receiver] = Heard(sent_s, arrivals, Lateness(way_s, timers_s[sender]))
    return heard


def check(
    study: Study,
    reports: Mapping[int, Mapping[str, Any]],
    came: Mapping[tuple[int, int], Sequence[Arrival]],
    counted: Applied,
) -> None:
    """Raises DisturbedError if the machine itself lost packets; of corrupted ones nobody can say who lost them."""
    for vehicle, report in reports.items():
        links = [link for link in came if link[1] == vehicle]
        if report["overflow"]:
            raise DisturbedError(f"The receive buffer of vehicle {vehicle} overflowed; {_TRY_AGAIN}")
        missing = counted.receivers[vehicle].passed - sum(len(came[link]) for link in links)
        if missing and not any(study.conditions.link(*link).corrupt for link in links):
            raise DisturbedError(f"The machine itself lost {missing} of the packets to vehicle {vehicle}; {_TRY_AGAIN}")


class Arrival(NamedTuple):
    """One copy of a packet, by its number from 0; times in seconds."""

    number: int
    sent_s: float
    at_s: float


def _arrivals(report: Mapping[str, Any], own: range) -> list[Arrival]:
    """Those of one sender, which has these numbers."""
    each = zip(report["numbers"], report["at_s"], report["delays_s"], strict=True)
    return [Arrival(number - own.start, at_s - delay_s, at_s) for number, at_s, delay_s in each if number in own]


async def _quiet(lab: Lab) -> Applied:
    """Wait until no packet is on its way any more; returns what the kernel then has counted."""
    before = None
    while before != (now := await lab.read()):
        before = now
        await asyncio.sleep(_QUIET_S)
    return now


class _Program:
    """A program of `netem._probe` that runs in a vehicle."""

    def __init__(self, process: LabProcess, output: Path) -> None:
        self._process = process
        self._output = output

    @classmethod
    async def start(cls, lab: Lab, folder: Path, vehicle: int, program: str, *arguments: object) -> _Program:
        output = folder / f"{program}-{vehicle}.log"
        argv = [sys.executable, "-I", "-S", str(Path(_probe.__file__)), program, *map(str, arguments)]
        environment = {"PATH": os.environ["PATH"]}
        process = await lab.spawn(vehicle, argv, cwd=folder, env=environment, stdout=output, stderr=output)
        return cls(process, output)

    async def wait_for(self, word: str) -> None:
        """Wait until it says that, or ends."""
        while word not in self._output.read_text() and self._process.returncode is None:
            await asyncio.sleep(0.01)

    async def stop(self) -> Any:
        """Have it end, and return its last word."""
        await self._process.send_signal(signal.SIGTERM)
        return await self.end()

    async def end(self) -> Any:
        """Wait for its end, and return its last word."""
        status = await self._process.wait()
        last = (self._output.read_text().splitlines() or [""])[-1]
        if status != 0:
            raise LabError(f"A program that measures ended with status {status}: {last}")
        return json.loads(last)

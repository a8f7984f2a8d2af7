"""Provide the packets for measurements. They are real packets in a virtual network, or simulated packets in virtual
time.
"""

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
from netem.engine import AppliedConditions
from netem.errors import LabError
from netem.estimates import MachineLateness, ReceivedStream
from netem.lab import EngineName, Lab, LabProcess
from netem.measure import DATA_BYTES, REFERENCE, NetworkStudy, Observer
from netem.medium import Medium

PAUSES_S = (0.005, 0.01, 0.02)
"""Pauses in seconds after every 20 packets of a sender, in ascending order. If the machine is too slow for a pause, the
measurement is repeated with the next pause.
"""
SPACING_S = 0.0003
"""Seconds between packets in virtual time."""

_PORT = 14600
_DEADLINE_S = 180.0  # of a stream
_QUIET_S = 0.5
_TRY_AGAIN = "this machine is too busy to measure just now: try again when it is idle"


def in_medium(seed: int) -> Observer:
    """Return a function that observes simulated packets. The machine adds no delay to them. The seed determines all
    results.
    """
    streams = itertools.count()

    def observe(study: NetworkStudy, packets: int) -> Mapping[tuple[int, int], ReceivedStream]:
        medium = Medium(study.vehicles, seed << 32 | next(streams))
        medium.apply(study.conditions)
        sent_s = [number * SPACING_S for number in range(packets)]
        received_packets: dict[tuple[int, int], list[tuple[float, int]]] = {
            (sender, receiver): [] for sender in study.senders for receiver in study.vehicles
        }
        for number, at_s in enumerate(sent_s):
            for sender in study.senders:
                for receiver, delay_s in medium.draw(study.vehicles.index(sender), at_s, DATA_BYTES).to_all():
                    received_packets[sender, study.vehicles[receiver]].append((at_s + delay_s, number))
        never = MachineLateness([0.0] * packets, [0.0] * packets)
        return {
            link: ReceivedStream(sent_s, [(number, at_s) for at_s, number in sorted(arrivals)], never)
            for link, arrivals in received_packets.items()
        }

    return observe


def in_lab(engine: EngineName) -> Observer:
    """Return a function that observes real packets. Each call of this function opens a new virtual network.

    If the engine counted more passed packets than arrived, the machine lost packets, because a receive buffer or the
    backlog of a processor was full. Such a stream cannot be used for the measurement, and the function sends a new
    stream more slowly. Raises LabError if packets are still lost or the lab fails, and LabUnavailable if this machine
    cannot run the lab.
    """

    def observe(study: NetworkStudy, packets: int) -> Mapping[tuple[int, int], ReceivedStream]:
        *quicker, slowest = PAUSES_S
        for pause_s in quicker:
            with contextlib.suppress(DisturbedError):
                return stream(study, packets, pause_s)
        return stream(study, packets, slowest)

    def stream(study: NetworkStudy, packets: int, pause_s: float) -> Mapping[tuple[int, int], ReceivedStream]:
        try:
            return asyncio.run(asyncio.wait_for(_observe(engine, study, packets, pause_s), _DEADLINE_S))
        except TimeoutError:
            raise LabError(f"A stream of {packets} packets did not end in time; {_TRY_AGAIN}") from None

    return observe


class DisturbedError(LabError):
    """An error: the machine itself lost packets, so the measurement is invalid."""


async def _observe(
    engine: EngineName, study: NetworkStudy, packets: int, pause_s: float
) -> dict[tuple[int, int], ReceivedStream]:
    vehicles = {*study.receivers, REFERENCE}
    numbers = {sender: range(i * packets, (i + 1) * packets) for i, sender in enumerate(study.senders)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        async with await Lab.open(study.vehicles, engine=engine, log=folder / "lab.log") as lab:
            await lab.apply(study.conditions)
            listeners = {
                vehicle: await _ProbeProgram.start(lab, folder, vehicle, "receive", _PORT) for vehicle in vehicles
            }
            for listener in listeners.values():
                await listener.wait_for("ready")
            senders = {}
            for sender, own in numbers.items():
                stream = (_PORT, packets, own.start, lab.broadcast, DATA_BYTES, pause_s)
                senders[sender] = await _ProbeProgram.start(lab, folder, sender, "broadcast", *stream)
            timers_s = {sender: (await program.end())["late_s"] for sender, program in senders.items()}
            counted = await _wait_until_quiet(lab)
            reports = {vehicle: await listener.stop() for vehicle, listener in listeners.items()}
    received_packets = {
        (sender, vehicle): _arrivals(reports[vehicle], own)
        for vehicle in vehicles
        for sender, own in numbers.items()
        if sender != vehicle  # its own broadcasts return to it at once
    }
    check(study, reports, received_packets, counted)
    streams = {}
    for sender in study.senders:
        reference = sorted(received_packets[sender, REFERENCE])
        sent_s, way_s = [packet.sent_s for packet in reference], [packet.at_s - packet.sent_s for packet in reference]
        if missing := packets - len(reference):
            raise DisturbedError(
                f"{missing} of {packets} packets were lost without a loss in the conditions; {_TRY_AGAIN}"
            )
        for receiver in study.receivers:
            if receiver != sender:
                arrivals = [(packet.number, packet.at_s) for packet in received_packets[sender, receiver]]
                streams[sender, receiver] = ReceivedStream(sent_s, arrivals, MachineLateness(way_s, timers_s[sender]))
    return streams


def check(
    study: NetworkStudy,
    reports: Mapping[int, Mapping[str, Any]],
    received_packets: Mapping[tuple[int, int], Sequence[PacketArrival]],
    counted: AppliedConditions,
) -> None:
    """Raise DisturbedError if the machine itself lost packets. Streams with corrupted packets are not checked, because
    their receivers also discard packets, so the cause of a loss is unknown.
    """
    for vehicle, report in reports.items():
        links = [link for link in received_packets if link[1] == vehicle]
        if report["overflow"]:
            raise DisturbedError(f"The receive buffer of vehicle {vehicle} overflowed; {_TRY_AGAIN}")
        missing = counted.receivers[vehicle].passed - sum(len(received_packets[link]) for link in links)
        if missing and not any(study.conditions.link(*link).corrupt for link in links):
            raise DisturbedError(f"The machine itself lost {missing} of the packets to vehicle {vehicle}; {_TRY_AGAIN}")


class PacketArrival(NamedTuple):
    """A received copy of a packet. Packets are numbered from 0. Times are in seconds."""

    number: int
    sent_s: float
    at_s: float


def _arrivals(report: Mapping[str, Any], own: range) -> list[PacketArrival]:
    """Return the received packets of one sender, numbered from 0. In the report of the receiver, the packets of all
    senders are numbered together. `own` is the range of numbers that belongs to this sender.
    """
    each = zip(report["numbers"], report["at_s"], report["delays_s"], strict=True)
    return [PacketArrival(number - own.start, at_s - delay_s, at_s) for number, at_s, delay_s in each if number in own]


async def _wait_until_quiet(lab: Lab) -> AppliedConditions:
    """Wait until no packet is in transit. Return the counters of the kernel."""
    before = None
    while before != (now := await lab.read()):
        before = now
        await asyncio.sleep(_QUIET_S)
    return now


class _ProbeProgram:
    """A program of `netem._probe` that runs in the network of a vehicle."""

    def __init__(self, process: LabProcess, output: Path) -> None:
        self._process = process
        self._output = output

    @classmethod
    async def start(cls, lab: Lab, folder: Path, vehicle: int, program: str, *arguments: object) -> _ProbeProgram:
        output = folder / f"{program}-{vehicle}.log"
        argv = [sys.executable, "-I", "-S", str(Path(_probe.__file__)), program, *map(str, arguments)]
        environment = {"PATH": os.environ["PATH"]}
        process = await lab.spawn(vehicle, argv, cwd=folder, env=environment, stdout=output, stderr=output)
        return cls(process, output)

    async def wait_for(self, word: str) -> None:
        """Wait until the output of the program contains `word`, or until the program ends."""
        while word not in self._output.read_text() and self._process.returncode is None:
            await asyncio.sleep(0.01)

    async def stop(self) -> Any:
        """End the program with SIGTERM, and return its results."""
        await self._process.send_signal(signal.SIGTERM)
        return await self.end()

    async def end(self) -> Any:
        """Wait until the program ends by itself, and return its results."""
        status = await self._process.wait()
        last = (self._output.read_text().splitlines() or [""])[-1]
        if status != 0:
            raise LabError(f"A measuring program ended with status {status}: {last}")
        return json.loads(last)

"""The targets by name; each is a module with `run`, which takes an input, and `seeds`, valid inputs to begin with.

datagram    what arrives on the port: codec, scapy's layers, events in a block
agent       an agent driven by a program: what liars send, timers, events, reboots, in any state
store       what a brown-out left on the disk
mission     the mission file
control     the control socket of an agent that runs
answer      what somebody's agent answers on its control socket
virtual     the lines that an agent is given in virtual time
foreign     the lines that an agent of somebody's answers there, and what becomes of the run
telemetry   MAVLink from the vehicle, and what is said of its events
by_hand     what a run that goes on is asked
scenario    a scenario in YAML: read, written, and a short one played
story       a story's file
trace       a trace of either version, by itself, among others and in its run; `events`, what was logged beside it
export      a chain export
run_record  run.json
network     network.jsonl, the record of who could reach whom
tracks      tracks.jsonl, where the vehicles were
capture     pcapng and pcap
flight_log  DataFlash and telemetry logs of vehicles
csv         records of others in CSV
bag         ROS bags of both versions, by any storage and packing
packed      a trace that gzip packed
depot       exports, mission files and manifests at the depot
matrix      a matrix, an earlier night's record, results
secured     an agent with keys driven by a program: others with keys and without, the authority, in any epoch and life
signed      a secured run's export with signatures, or its public keys
keys        bundles, public and private keys, revocations
"""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Protocol

NAMES = (
    *("datagram", "agent", "store", "mission", "control", "answer", "virtual", "foreign"),
    *("telemetry", "scenario", "story", "trace", "events", "export", "run_record", "network"),
    *("tracks", "capture", "csv", "bag", "packed", "depot", "matrix", "by_hand", "keys"),
    *("secured", "signed", "flight_log"),
)


class Target(Protocol):
    """One reader, and all that stands on it."""

    def run(self, data: bytes) -> None:
        """Raises FailedError, or whatever else, if the reader does what none may do with any input."""

    def seeds(self, flown: Path) -> Iterator[bytes]:
        """Valid inputs; `flown` is the directory of a run in virtual time."""


def named(name: str) -> Target:
    target: Target = import_module(f"{__name__}.{name}")  # type: ignore[assignment]
    return target

"""List the fuzz targets by name. Each is a module with a function `run` for an input, and `seeds` for valid inputs.

datagram    a datagram on the port: codec, clear header, events in a block
layers      the same datagrams in scapy's layers
agent       an agent in any state, with forged messages, timers, events and reboots
store       a store after a brown-out
mission     a mission file
control     requests on the control socket of an agent
answer      answers of an agent on its control socket
virtual     the input lines of an agent in virtual time
foreign     the answer lines of a foreign agent in virtual time, and the run with this agent
telemetry   MAVLink of a vehicle, and the text of its events
by_hand     requests to an active run
scenario    a scenario in YAML: read, written, and a short one played
story       a story file
trace       a trace of either version, alone, among others, and in its run
events      a log of events next to a trace
export      a chain export
run_record  run.json
network     network.jsonl, the conditions between vehicles
tracks      tracks.jsonl, the positions of vehicles
capture     pcapng and pcap
flight_log  DataFlash and telemetry logs of vehicles
csv         records of other implementations in CSV
bag         ROS bags of both versions, with any storage and compression
packed      a trace that gzip compressed
depot       exports, mission files and manifests at the depot
matrix      a matrix file, the record of an earlier night, and results
secured     an agent with keys, in any epoch and incarnation, with messages of senders with and without keys
signed      the export of a secured run with signatures, or its public keys
join        the handshake and the messages of a computer that joins a lab
keys        bundles, public and private keys, revocations
"""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Protocol

NAMES = (
    *("datagram", "layers", "agent", "store", "mission", "control", "answer", "virtual", "foreign"),
    *("telemetry", "scenario", "story", "trace", "events", "export", "run_record", "network"),
    *("tracks", "capture", "csv", "bag", "packed", "depot", "matrix", "by_hand", "keys"),
    *("secured", "signed", "flight_log", "join"),
)


class Target(Protocol):
    """A reader of external input, with the code that uses its result."""

    def run(self, data: bytes) -> None:
        """Give the input to the reader. Raises FailedError or another exception if the reader violates a condition."""

    def seeds(self, flown: Path) -> Iterator[bytes]:
        """Yield valid inputs. `flown` is the directory of a run in virtual time."""


def named(name: str) -> Target:
    target: Target = import_module(f"{__name__}.{name}")  # type: ignore[assignment]
    return target

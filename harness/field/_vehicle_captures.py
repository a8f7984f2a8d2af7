"""Read the packet capture of one vehicle from the field. The capture contains the datagrams that the agent of the
vehicle sent, and those that reached the vehicle.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.packets.capture_reader import Capture, NotUcpError, unwrap
from harness.archive.packets.pcap import OUTBOUND, CaptureFile
from ucp.clock import MICROSECONDS
from ucp.events import LoggableEvent
from ucp.messages import HEADER, MalformedDatagramError, decode
from ucp.secure.envelope import CONTROL_NAMES
from ucp.secure.envelope import VERSION as SECURED

if TYPE_CHECKING:
    from ucp.secure.opening import DatagramOpener

NANOSECONDS = 1_000_000_000


@dataclass(slots=True)
class CapturedDatagram:
    """A datagram at the network interface of a vehicle. `at_s` is the mission second on the vehicle's clock."""

    at_s: float
    outbound: bool
    sender: int
    sequence: int
    datagram: bytes


@dataclass
class AgentCapture:
    """The datagrams in the packet capture of a vehicle, in order of time."""

    epoch_us: float
    """The time of mission second 0 on the clock of the vehicle, in microseconds."""
    speedup: float
    sightings: list[CapturedDatagram] = field(default_factory=list)
    unreadable: int = 0
    """Number of encrypted datagrams that no given key decrypts."""


def read_capture(
    path: Path, agent_id: int, epoch_us: int | None, opener: "DatagramOpener | None" = None
) -> AgentCapture:
    """Read the capture of an agent. Raises CaptureError."""
    capture_file = Capture(0, path)
    capture_file.read({}, most_frames=1)
    frames = [*CaptureFile(path)]
    if capture_file.comment is not None:
        capture = AgentCapture(float(capture_file.comment.epoch_us), capture_file.comment.speedup)
    else:
        first_ns = min((frame.time_ns for frame in frames), default=0)
        capture = AgentCapture(float(epoch_us if epoch_us is not None else first_ns // 1000), 1.0)
    epoch_ns = capture.epoch_us * 1000
    for frame in frames:
        try:
            datagram, direction = unwrap(frame)
            is_sealed = len(datagram) >= HEADER.size and datagram[2] == SECURED
            if is_sealed and opener is not None:
                datagram = opener.open(datagram).datagram.encode()
            sender, sequence, _ = decode(datagram)
        except NotUcpError:
            continue
        except MalformedDatagramError:
            capture.unreadable += is_sealed and datagram[3] not in CONTROL_NAMES
            continue
        outbound = direction == OUTBOUND or (not direction and sender == agent_id)
        if outbound == (sender == agent_id):
            at_s = (frame.time_ns - epoch_ns) / NANOSECONDS * capture.speedup
            capture.sightings.append(CapturedDatagram(at_s, outbound, sender, sequence, datagram))
    capture.sightings.sort(key=lambda sighting: sighting.at_s)
    return capture


def seconds_of(event: LoggableEvent, capture: AgentCapture) -> float:
    """Return the mission second at which an agent logged an event. The capture contains the start of the mission on the
    clock of the agent's vehicle.
    """
    return (event.timestamp_us - capture.epoch_us) / MICROSECONDS

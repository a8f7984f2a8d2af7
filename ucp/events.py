"""Define loggable events, their encoding in a block, and the random generator of Algorithm 21.

The `event_data` of a block is a sequence of encoded events. An encoded event is `timestamp_us (u64) || event_id (u8,
1..254) || length (u16) || data`, big-endian (Section 4.1).
"""

from random import Random
from typing import Literal

from ucp._dataclass import dataclass
from ucp.wire import FieldKind, struct_of

EVENT_FIELDS = {"timestamp_us": FieldKind.U64, "event_id": FieldKind.U8, "length": FieldKind.U16}
"""The fields of an event header."""
_HEADER = struct_of(EVENT_FIELDS)
EVENT_HEADER_BYTES = _HEADER.size
MAX_EVENT_BYTES = EVENT_HEADER_BYTES + 256
"""Maximum size of an event in the thesis: a header and 256 bytes of data."""

MEAN_TIME_BETWEEN_EVENTS_S = 30.0
MAX_MEAN_S = 31 * 86400.0
"""Maximum mean interval of random events in seconds. The limit is longer than any mission. If it were longer still, the
search for the next event could take minutes.
"""
TRIAL_PERIOD_S = 1.0
EVENT_DATA_BYTES = (32, 64, 128, 256)


EventKind = Literal["mode", "arming", "text", "waypoint", "failsafe", "position", "battery"]
"""A kind of telemetry event that a mission can select."""

DEFAULT_LOG: tuple[EventKind, ...] = ("mode", "arming", "text", "position")


class MalformedEventsError(ValueError):
    """An error: event data does not consist of complete events."""


@dataclass(unsafe_hash=True, slots=True)
class LoggableEvent:
    """An event that a vehicle logs (Section 3.1).

    Treat it as immutable. It is not frozen, because creating a frozen object takes three times as long.
    """

    timestamp_us: int
    event_id: int
    data: bytes

    def __post_init__(self) -> None:
        if not 1 <= self.event_id <= 254:
            raise ValueError(f"event_id {self.event_id} is not in 1..254")

    @property
    def encoded_bytes(self) -> int:
        return EVENT_HEADER_BYTES + len(self.data)

    def encode(self) -> bytes:
        return _HEADER.pack(self.timestamp_us, self.event_id, len(self.data)) + self.data


def decode_events(event_data: bytes) -> list[LoggableEvent]:
    """Return the events in a block's event data. The oldest is first.

    Raises MalformedEventsError with the offset of the error.
    """
    events = []
    offset = 0
    while offset < len(event_data):
        event, offset = decode_event(event_data, offset)
        events.append(event)
    return events


def decode_event(event_data: bytes, offset: int) -> tuple[LoggableEvent, int]:
    """Return the event that begins at `offset`, and the offset at which the event ends. Raises MalformedEventsError."""
    body = offset + EVENT_HEADER_BYTES
    if body > len(event_data):
        raise MalformedEventsError(f"event header at byte {offset} is cut off")
    timestamp_us, event_id, length = _HEADER.unpack_from(event_data, offset)
    if body + length > len(event_data):
        raise MalformedEventsError(f"event at byte {offset} claims {length} bytes, more than are left")
    if not 1 <= event_id <= 254:
        raise MalformedEventsError(f"event at byte {offset} has event_id {event_id}, not in 1..254")
    return LoggableEvent(timestamp_us, event_id, event_data[body : body + length]), body + length


class RandomEvents:
    """The random event source of Algorithm 21. Once per second it logs an event with probability 1 / mean interval. The
    event has a random ID and random data.

    The thesis does not specify the period of the loop. This implementation tries once per second, and each agent starts
    at a random fraction of a second.
    """

    def __init__(self, rng: Random, mean_s: float = MEAN_TIME_BETWEEN_EVENTS_S) -> None:
        self._rng = rng
        self._probability = TRIAL_PERIOD_S / mean_s
        self._next_trial_s = rng.random() * TRIAL_PERIOD_S

    def next(self) -> tuple[float, int, bytes]:
        """Draw random numbers until an event occurs, and return it as (mission second, event_id, data)."""
        lot, probability, at_s = self._rng.random, self._probability, self._next_trial_s
        while lot() > probability:
            at_s += TRIAL_PERIOD_S
        self._next_trial_s = at_s + TRIAL_PERIOD_S
        return at_s, self._rng.randint(1, 254), self._rng.randbytes(self._rng.choice(EVENT_DATA_BYTES))

"""Fuzz target: the MAVLink stream of a vehicle. Each resulting event fits into a block and has a description."""

from collections.abc import Iterator
from pathlib import Path
from random import Random

from pymavlink.dialects.v20 import common

from tests.fuzz.finding import require, sound
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.events import LoggableEvent
from ucp.telemetry import EVENT_KINDS, MAX_DATA_BYTES, TelemetryEvents, describe, position_of


def run(data: bytes) -> None:
    translator = TelemetryEvents(1.0, Random(1), EVENT_KINDS)
    size = 1 + (data[0] if data else 0)
    for piece, start in enumerate(range(1, len(data), size)):
        for event_id, event in translator.receive(data[start : start + size], float(piece)):
            require(len(event) <= MAX_DATA_BYTES, f"an event of {len(event)} bytes")
            LoggableEvent(0, event_id, event).encode()
            words = describe(event_id, event)
            sound(words)
            require(words != "unreadable", "its own event is unreadable")
            position_of(event_id, event)
    for event_id in range(9):
        sound(describe(event_id, data[:MAX_EVENT_DATA_BYTES]))
        position_of(event_id, data)


def seeds(flown: Path) -> Iterator[bytes]:
    sender = common.MAVLink(None, 1, 1)
    messages = [
        sender.heartbeat_encode(2, 3, 0x80, 4, 4),
        sender.heartbeat_encode(2, 3, 0, 0, 5),
        sender.sys_status_encode(1, 1, 0, 500, 11000, 100, 37, 0, 0, 0, 0, 0, 0),
        sender.attitude_encode(5000, 0.1, 0.2, 0.3, 0, 0, 0),
        sender.system_time_encode(1_790_000_000_000_000, 5000),
        sender.global_position_int_encode(5000, 488_000_000, 23_000_000, 100_000, 5000, 1, 2, 3, 9000),
        sender.statustext_encode(4, b"Failsafe"),
        sender.mission_item_reached_encode(3),
    ]
    stream = b"".join(message.pack(sender) for message in messages)
    yield b"\xff" + stream
    yield b"\x10" + stream + stream

"""Fuzz target: a log of events (`ucp-events/1`) from a recorder that runs next to the agent."""

import json
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.targets.home import came_home

LINES = 5


def run(data: bytes) -> None:
    came_home("events.jsonl", data)


def seeds(flown: Path) -> Iterator[bytes]:
    event = {"schema": "ucp-events/1", "agent_id": 1, "event_id": 3, "data": "YWJj"}
    yield "".join(json.dumps({**event, "time_us": at}) + "\n" for at in range(LINES)).encode()

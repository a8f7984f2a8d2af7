"""Test the program of the agent in virtual time: an input that it refuses changes nothing."""

import io
import json
from typing import Any

import pytest

from ucp.contract.vectors import MISSIONS
from ucp.virtual import serve

VECTOR = MISSIONS / "alone.jsonl"
START: dict[str, Any] = json.loads(VECTOR.read_text("utf-8").splitlines()[0])["input"]


def answers(*inputs: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the agent's answer to each input."""
    lines = io.BytesIO(b"".join(json.dumps(given).encode() + b"\n" for given in inputs))
    written = io.BytesIO()
    serve(lines, written)
    return [json.loads(line) for line in written.getvalue().splitlines()]


@pytest.mark.parametrize(
    "refused",
    [{"t": 9.0}, {"t": 9.0, "datagram": "?"}, {"t": 9.0, "event_id": 0, "timestamp_us": 0, "data": ""}],
)
def test_refused_input_leaves_the_time_of_the_agent(refused: dict[str, Any]) -> None:
    start, error, status = answers(START, refused, {"t": 1.0, "command": "status"})

    assert "error" not in start and "error" in error
    assert status["answer"]["mission_s"] == 1.0

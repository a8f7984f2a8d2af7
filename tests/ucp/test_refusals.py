"""Test that the agent of the harness answers ambiguous missions and requests as the test vectors require."""

import sys
from pathlib import Path

from tests.ucp import refusals
from ucp.features import FEATURES

COMMAND = [sys.executable, "-P", "-m", "ucp.node"]


def test_agent_plays_or_refuses_ambiguous_missions_as_specified(tmp_path: Path) -> None:
    assert not refusals.wrong_missions(COMMAND, [*FEATURES])
    assert not refusals.wrong_exits(COMMAND, [*FEATURES], tmp_path)


def test_agent_answers_ambiguous_requests_as_in_the_vectors(tmp_path: Path) -> None:
    assert not refusals.wrong_answers(COMMAND, tmp_path)

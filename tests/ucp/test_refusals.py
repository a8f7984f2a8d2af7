"""Missions and requests in doubt: the agent of the harness answers as in the vectors."""

import sys
from pathlib import Path

from tests.ucp import refusals
from ucp.features import FEATURES

COMMAND = [sys.executable, "-P", "-m", "ucp.node"]


def test_missions_in_doubt_are_played_or_refused(tmp_path: Path) -> None:
    assert not refusals.wrong_missions(COMMAND, [*FEATURES])
    assert not refusals.wrong_exits(COMMAND, [*FEATURES], tmp_path)


def test_requests_in_doubt_are_answered_as_in_the_vectors(tmp_path: Path) -> None:
    assert not refusals.wrong_answers(COMMAND, tmp_path)

"""Describe the task of a stand-in. The harness passes the task on the command line of the stand-in, and not in the
mission file, because a conformance test also uses invalid mission files.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class StandInTask:
    """The task of a stand-in. It describes the agent that the stand-in represents."""

    number: int
    """The number by which the harness identifies the stand-in."""
    agent_id: int
    vehicle: int
    """The vehicle whose network and address the agent uses."""
    port: int
    speedup: float
    measures_lag: bool
    """True if the far end measures the lag of its computer."""

    def command(self, socket: Path) -> list[str]:
        """Return the command of the stand-in, without the mission file. `socket` is a socket of the harness, to which
        the stand-in connects.
        """
        stand_in = [sys.executable, "-P", "-m", "harness.play.remote.stand_in"]
        return [*stand_in, str(socket), json.dumps(asdict(self))]

    @classmethod
    def parse(cls, text: str) -> StandInTask:
        return cls(**json.loads(text))

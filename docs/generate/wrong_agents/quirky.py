"""Run an agent with a deliberate error: `python -m docs.generate.wrong_agents.quirky QUIRK MISSION_FILE`, or `QUIRK
--virtual`.

The program is the same as `python -m ucp.node`, except that it adds this quirk to every mission.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ucp import node, virtual
from ucp.quirks import QUIRKS

PROBABILITY = 0.2
"""The probability of the error, for quirks that need a probability."""


def wrong(mission: dict[str, Any], quirk: str) -> dict[str, Any]:
    """Return the mission file with the deliberate error added."""
    quirks = {**mission.get("quirks", {}), quirk: PROBABILITY if QUIRKS[quirk].chance else True}
    features = list(dict.fromkeys([*mission.get("features", []), "quirks"]))
    return {**mission, "quirks": quirks, "features": features}


class _Lines:
    """Standard input of an agent in virtual time, with the deliberate error added to each mission."""

    def __init__(self, quirk: str) -> None:
        self._quirk = quirk

    def readline(self, limit: int) -> bytes:
        line = sys.stdin.buffer.readline(limit)
        given = json.loads(line) if line else {}
        if "mission" in given:
            return json.dumps({**given, "mission": wrong(given["mission"], self._quirk)}).encode() + b"\n"
        return line

    def __iter__(self) -> Iterator[bytes]:
        return iter(lambda: self.readline(virtual.MAX_LINE_BYTES), b"")


def main(arguments: Sequence[str]) -> int:
    quirk, mission_file = arguments
    if mission_file == "--virtual":
        virtual.serve(_Lines(quirk), sys.stdout.buffer)  # type: ignore[arg-type]  # only lines are read
        return 0
    path = Path(mission_file)
    path.write_text(json.dumps(wrong(json.loads(path.read_text(encoding="utf-8")), quirk)), encoding="utf-8")
    return node.main([str(path)])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

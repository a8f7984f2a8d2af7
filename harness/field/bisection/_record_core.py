"""The process in which another state's core is given records: `python -m harness.field.bisection._record_core PATH
[AGENT]`.

Whoever starts it puts that state's `ucp` before the installed one. It prints one JSON document: by agent what the core
does other than the record, in the order of the record.
"""

import json
import sys
from pathlib import Path
from typing import Any

import ucp
from harness.checker.steps.core_in_use import IN_USE
from harness.errors import HarnessError
from harness.field.ingest import sort_out
from harness.field.replay import Player, open_record
from harness.field.replay.replay_names import Names

MAX_DIFFERENCES = 10_000


def differences(path: Path, agent: int | None) -> list[dict[str, Any]]:
    """Raises HarnessError if there is nothing to play."""
    record = open_record(path, agent)
    found, names = Player(record, implementation=IN_USE).to_end(), Names(record)
    deviations = sorted(found.deviations, key=lambda deviation: deviation.line)
    return [
        {
            "line": deviation.line,
            "handler": deviation.handler,
            "detail": deviation.difference(names.of),
        }
        for deviation in deviations[:MAX_DIFFERENCES]
    ]


def main(arguments: list[str]) -> int:
    path = Path(arguments[0])
    agents = [int(arguments[1])] if len(arguments) > 1 else _agents(path)
    try:
        found = {agent: differences(path, agent if path.is_dir() else None) for agent in agents}
    except HarnessError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_status
    sys.stdout.write(json.dumps({"ucp": ucp.__file__, "agents": found}) + "\n")
    return 0


def _agents(path: Path) -> list[int]:
    """All that have a record in it, of the flight with the most in it."""
    return sorted(sort_out([path]).largest().traces)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

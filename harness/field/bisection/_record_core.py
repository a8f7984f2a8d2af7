"""Replay records with the agent core of another commit: `python -m harness.field.bisection._record_core PATH [AGENT]`.

The caller puts the `ucp` package of that commit first in the module path. The process prints one JSON document with the
differences between core and record, by agent and in the order of the record.
"""

import json
import sys
from pathlib import Path
from typing import Any

import ucp
from harness.checker.steps.core_in_use import IN_USE
from harness.errors import HarnessError
from harness.field.ingest import ingest_files
from harness.field.replay import RecordPlayer, open_record
from harness.field.replay.replay_names import ReplayNames

MAX_DIFFERENCES = 10_000


def differences(path: Path, agent: int | None) -> list[dict[str, Any]]:
    """Return the differences between the agent core and the record at `path`. Raises HarnessError if the record cannot
    be replayed.
    """
    record = open_record(path, agent)
    result, names = RecordPlayer(record, implementation=IN_USE).to_end(), ReplayNames(record)
    deviations = sorted(result.deviations, key=lambda deviation: deviation.line)
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
        result = {agent: differences(path, agent if path.is_dir() else None) for agent in agents}
    except HarnessError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_status
    sys.stdout.write(json.dumps({"ucp": ucp.__file__, "agents": result}) + "\n")
    return 0


def _agents(path: Path) -> list[int]:
    """Return the IDs of all agents that have a trace in the largest flight at this path."""
    return sorted(ingest_files([path]).largest().traces)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

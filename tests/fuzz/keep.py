"""Select the inputs in tests/corpus again: `python -m tests.fuzz.keep [TARGET ...]`.

The candidates are the seeds, the inputs that `python -m tests.fuzz` left in .fuzz, and the stored inputs. The program
selects the inputs that cover the most pairs of successively executed lines of the project. It prefers small inputs, and
keeps all regressions.
"""

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

from tests.fuzz.__main__ import GROWN
from tests.fuzz.corpus import FOLDER, REGRESSION, files_of
from tests.fuzz.execute import executed
from tests.fuzz.targets import NAMES, Target, named
from tests.fuzz.targets.home import run_of_three

MOST_FILES = 11
MOST_BYTES = 45_000
MOST_BYTES_EACH = 40_000
"""Maximum number and maximum sizes of the selected inputs of a target."""
_PROJECT = tuple(str(Path(__file__).parents[2] / room) for room in ("ucp", "harness", "netem", "sitl"))

Way = tuple[str, int, int]


def main(names: list[str]) -> None:
    with TemporaryDirectory(prefix="ucp-fuzz-") as scratch:
        flown = run_of_three(Path(scratch) / "run")
        for name in names or NAMES:
            kept = _keep(name, flown)
            sys.stdout.write(f"{name:11} {len(kept):3} files, {sum(map(len, kept))} bytes\n")
            sys.stdout.flush()


def _keep(name: str, flown: Path) -> list[bytes]:
    target = named(name)
    former = [path for path in files_of(name) if not path.name.startswith(REGRESSION)]
    grown = sorted((GROWN / name).iterdir()) if (GROWN / name).is_dir() else []
    candidates = {*target.seeds(flown), *(path.read_bytes() for path in (*former, *grown))}
    kept = list(_best({data: _ways(target, data) for data in sorted(candidates, key=len)}))
    (FOLDER / name).mkdir(parents=True, exist_ok=True)
    for path in former:
        path.unlink()
    for data in kept:
        (FOLDER / name / hashlib.sha1(data, usedforsecurity=False).hexdigest()[:12]).write_bytes(data)
    return kept


def _best(ways: dict[bytes, frozenset[Way]]) -> Iterator[bytes]:
    """Yield the inputs to keep, within the limits. Each next input is the one that covers the most pairs of lines not
    covered by the previous ones.
    """
    covered: set[Way] = set()
    left = MOST_BYTES
    for _ in range(MOST_FILES):
        fitting = [data for data in ways if len(data) <= min(left, MOST_BYTES_EACH)]
        best = max(fitting, key=lambda data: (len(ways[data] - covered), -len(data)), default=b"")
        if best not in ways or not ways[best] - covered:
            return
        covered |= ways[best]
        left -= len(best)
        yield best


def _ways(target: Target, data: bytes) -> frozenset[Way]:
    ways: set[Way] = set()

    def enter(frame: FrameType, event: str, argument: Any) -> Any:
        file = frame.f_code.co_filename
        if not file.startswith(_PROJECT):
            return None
        last = frame.f_lineno

        def step(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal last
            if event == "line":
                ways.add((file, last, frame.f_lineno))
                last = frame.f_lineno
            return step

        return step

    former = sys.gettrace()
    sys.settrace(enter)
    try:
        executed(target, data)
    except Exception as error:
        sys.stdout.write(f"fails: {type(error).__name__}: {str(error)[:200]}\n")
    finally:
        sys.settrace(former)
    return frozenset(ways)


if __name__ == "__main__":
    main(sys.argv[1:])

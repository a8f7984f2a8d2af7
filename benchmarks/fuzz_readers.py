"""Damaged files through all that reads what came home: `python -m benchmarks.fuzz_readers --files 100000 [--seed 1]`.

Each file is a valid one (traces of both versions, exports, captures, run.json, CSV, bags of both versions and all
storages and packings, gzip) with one to four damages: flipped bits, cuts, NUL, lines twice or exchanged, values of
JSON that are of another type, huge, nested deeply or no JSON at all. It goes through `sort_out` and `import`, a trace
through `replay`, and what is of a run directory through the archive's readers. None may raise anything but a sentence,
take more than 20 s or 512 MiB, or leave anything out without saying so. A file that breaks this is kept, and the exit
status is 1.
"""

import argparse
import sys
import time
from pathlib import Path
from tempfile import mkdtemp

from tests.harness.field.fuzz import FailedError, Outcome, fuzz

TOLD_EVERY = 1000


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the number of the first file: to go on, or look at one")
    asked = parser.parse_args()
    outcome, number, failed = Outcome(), asked.first, 0
    began = time.monotonic()
    while number < asked.first + asked.files:
        directory = Path(mkdtemp(prefix="fuzz-"))
        try:
            left = asked.first + asked.files - number
            for done in fuzz(directory, asked.seed, number, left, outcome):
                number = done
                if (number + 1) % TOLD_EVERY == 0:
                    _tell(number + 1 - asked.first, failed, outcome, time.monotonic() - began)
        except FailedError as error:
            failed += 1
            sys.stdout.write(f"FAILED {error}\n")
            number = error.number
        number += 1
    _tell(asked.files, failed, outcome, time.monotonic() - began)
    return 1 if failed else 0


def _tell(files: int, failed: int, outcome: Outcome, seconds: float) -> None:
    counts = ", ".join(f"{reader} {how} {count}" for (reader, how), count in sorted(outcome.counts.items()))
    sys.stdout.write(f"{files} files in {seconds:.0f} s, {failed} failed; {counts}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())

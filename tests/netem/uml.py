"""Runs the tests of real netem inside User Mode Linux, a kernel that has it: `python -m tests.netem.uml`.

The same tests run in the same virtual environment, see `netem.uml`. Arguments go to pytest. The exit status is
pytest's, or 3 if User Mode Linux is not here, does not boot, hangs or panics.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from netem import uml
from netem.errors import UmlError

REPOSITORY = Path(__file__).parents[2]
DEADLINE_S = os.environ.get("UCP_UML_DEADLINE_S", "1500")

# Without test_leftovers.py, which finds processes by their environment: this kernel does not show it.
# What ends the lab is not netem's, and is tested on the host.
_FILES = (
    "tests/netem/test_engine.py",
    "tests/netem/test_links.py",
    "tests/netem/test_lab.py",
    "tests/netem/test_machine.py",
    "tests/netem/test_agreement.py",
    "tests/netem/test_capture.py",
    "tests/netem/test_measure.py",
    "tests/harness/test_netem_run.py",
)
_TESTS = ("-q", "-k", "not nftables", *_FILES)


def main(arguments: list[str]) -> int:
    """Boot, run, and return pytest's exit status."""
    pytest = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", *(arguments or _TESTS)]
    environment = {
        "UCP_TEST_PACKETS": "1500",
        "LANG": "C.UTF-8",
        **os.environ,
        "HOME": "/run/tmp",  # the guest's own
        "PYTHONDONTWRITEBYTECODE": "1",
        "UCP_REQUIRE": "lab,netem",
    }
    try:
        return uml.run(["timeout", "--foreground", DEADLINE_S, *pytest], cwd=REPOSITORY, env=environment)
    except UmlError as error:
        sys.stderr.write(f"{error}\n")
        return 3


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

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

# Programs in the lab and how they end, who may have one, taps and statistics have nothing to do with netem: they are
# tested on the host, and a test takes ten times as long in here.
_OF_NETEM = (
    "tests/netem/test_engine.py",
    "tests/netem/test_links.py",
    "tests/netem/test_lab.py::test_a_cable_can_end_in_a_network_that_is_there_already",
    "tests/netem/test_lab.py::test_an_idle_lab_is_silent",
    "tests/netem/test_lab.py::test_a_connection_to_nobody_times_out_and_stalls_nobody",
    "tests/netem/test_lab.py::test_several_labs_run_at_once_and_do_not_hear_each_other",
    "tests/netem/test_machine.py::test_an_ordinary_user_gets_a_lab_without_any_right",
    "tests/netem/test_machine.py::test_an_engine_that_the_kernel_lacks_is_refused_with_the_way_out",
    "tests/netem/test_machine.py::test_doctor_finds_what_a_lab_finds",
    "tests/netem/test_agreement.py",
    "tests/netem/test_capture.py::test_what_is_lost_or_cut_off_on_its_way_is_in_its_senders_file_alone",
    "tests/netem/test_capture.py::test_a_frame_is_there_as_often_and_as_late_as_its_receiver_got_it",
    "tests/netem/test_measure.py::test_real_packets_fare_as_asked",
    "tests/netem/test_measure.py::test_a_network_that_loses_more_than_asked_is_found",
    "tests/netem/test_measure.py::test_a_network_that_delays_longer_than_asked_is_found",
    "tests/harness/play/test_netem_run.py",
)
_TESTS = ("-q", "-k", "not nftables", *_OF_NETEM)


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

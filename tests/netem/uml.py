"""Run the tests of netem inside User Mode Linux: `python -m tests.netem.uml`.

The tests and the Python environment are the same as outside (see `netem.uml`). The program passes its arguments to
pytest. The exit status is that of pytest. It is 3 if User Mode Linux is missing, does not boot, hangs or panics.
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
    "tests/netem/test_relay.py",
    "tests/netem/test_lab.py::test_cable_can_end_in_an_existing_network",
    "tests/netem/test_lab.py::test_idle_lab_is_silent",
    "tests/netem/test_lab.py::test_connection_without_listener_times_out_and_delays_no_other",
    "tests/netem/test_lab.py::test_simultaneous_labs_do_not_receive_each_other",
    "tests/netem/test_machine.py::test_ordinary_user_can_open_a_lab",
    "tests/netem/test_machine.py::test_missing_engine_is_refused_with_the_remedy",
    "tests/netem/test_machine.py::test_doctor_agrees_with_the_engines_of_a_lab",
    "tests/netem/test_agreement.py",
    "tests/netem/test_capture.py::test_lost_and_cut_frames_are_only_in_the_file_of_their_sender",
    "tests/netem/test_capture.py::test_file_of_the_receiver_has_duplicates_and_delays",
    "tests/netem/test_measure.py::test_answers_with_real_packets_are_ok",
    "tests/netem/test_measure.py::test_network_with_excessive_loss_is_found",
    "tests/netem/test_measure.py::test_network_with_excessive_delay_is_found",
    "tests/harness/play/test_netem_run.py",
)
_TESTS = ("-q", "-k", "not nftables", *_OF_NETEM)


def main(arguments: list[str]) -> int:
    """Boot User Mode Linux, run the tests, and return pytest's exit status."""
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

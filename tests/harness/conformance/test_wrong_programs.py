"""Test that handwritten test cases detect programs with errors outside the 20 algorithms."""

import asyncio
import sys
from pathlib import Path

import pytest

from harness.conformance._udp_lab import UdpLab
from harness.conformance.cases import ALL_CASES, _play
from harness.conformance.results import CaseResult
from tests.harness.conformance import wrong_programs

pytestmark = pytest.mark.lab

INPUTS = "the trace has each datagram, event and command, in order and with its time"
HEADER = "the first line of the trace describes the mission"
STEPS = "each handler run in the trace follows Algorithms 1 to 20"
AGREE = "status, chain export and trace agree"


def played(case: str, place: Path, *command: str) -> CaseResult:
    async def play() -> CaseResult:
        async with UdpLab(place, command, 1) as lab:
            return await _play(lab, next(each for each in ALL_CASES if each.name == case))

    return asyncio.run(play())


@pytest.mark.parametrize("case", [INPUTS, HEADER, STEPS, AGREE])
@pytest.mark.any_user
def test_records_of_reference_pass(case: str, tmp_path: Path) -> None:
    result = played(case, tmp_path, sys.executable, "-P", "-m", "ucp.node")
    assert result.verdict == "passed", result.reason


@pytest.mark.any_user
@pytest.mark.parametrize(
    ("mistake", "case", "reason"),
    [
        ("omits_commits_from_trace", INPUTS, "lines for 4 messages; came 3 lines"),
        ("omits_drops_from_trace", INPUTS, "lines for 2 dropped datagrams"),
        ("omits_commands_from_trace", INPUTS, "lines for the commands stop_events and export"),
        ("writes_wall_seconds_into_trace", INPUTS, "for a message of that mission second"),
        ("keeps_trace_in_memory", HEADER, "its first line is missing or invalid"),
        ("leaves_settings_out_of_header", HEADER, "other values of vote_timeout_s"),
        ("stamps_block_with_first_event", STEPS, "Algorithm 1, build_data_block"),
        ("exports_no_completed_blocks", AGREE, "the completed blocks of the trace"),
        ("leaves_children", "the agent leaves no process running at its end", "came sleep"),
        ("leaks_descriptors", "inputs and clients leave no descriptors open", "after 50 messages and clients; came 5"),
        ("writes_export_in_place", "a chain export replaces the earlier one in one step", "came the same"),
        ("leaves_other_files", "the agent leaves no control socket and no other files at its end", "came scratch.tmp"),
        ("sends_after_sigterm", "SIGINT exports the chain, exit status 0", "came Chain Contain Query"),
        (
            "ends_with_status_3_without_a_mission",
            "SIGTERM before the mission starts exports the chain, exit status 0",
            "expected exit status 0; came status 3",
        ),
        (
            "dies_of_a_second_sigterm",
            "SIGTERM twice during a reconcile exports the chain once, exit status 0",
            "came status -15",
        ),
        ("receives_only_1500_bytes", "malformed datagrams are dropped and change nothing", "expected `dropped`"),
        (
            "ignores_requested_quirks",
            "an agent makes a requested mistake, or refuses the mission with status 127",
            "as `ignore_commit` 1 requests",
        ),
        ("exports_at_wrong_time", AGREE, "`exported_at_us` at mission second"),
    ],
)
def test_wrong_record_fails_its_case(mistake: str, case: str, reason: str, tmp_path: Path) -> None:
    result = played(case, tmp_path, sys.executable, "-P", "-m", wrong_programs.__name__, mistake)
    assert result.verdict == "failed"
    assert reason in result.reason

"""Test `ucp-harness doctor --measure`: its table, its JSON output and its exit status."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping

import pytest
from typer.testing import CliRunner, Result

from harness import cli
from harness.commands import doctor as doctor_module
from harness.play.machine import capabilities
from harness.play.machine.capabilities import MachineRequirement
from netem.conditions import NetworkConditions
from netem.errors import LabError
from netem.estimates import MachineLateness, ReceivedStream, lost
from netem.measure import MeasuredQuantity, NetworkStudy, Observer

WORKS = [
    MachineRequirement("netem", False, False, "unknown"),
    MachineRequirement("nftables", True, False, "works"),
    MachineRequirement("engine", True, True, "nftables"),
]
NOTHING_WORKS = [MachineRequirement("engine", False, True, "nothing works", "install nftables")]
STUDY = NetworkStudy(NetworkConditions(), (MeasuredQuantity(1, 4, "loss 0.15", "lost", 0.15, lost),))


def losing(*shares: float) -> Observer:
    """Return a function that replaces a measurement. Each call of the function reports the next of these loss rates."""
    streams = iter(shares)

    def observe(study: NetworkStudy, packets: int) -> Mapping[tuple[int, int], ReceivedStream]:
        first = round(next(streams) * packets)
        lateness = MachineLateness([0.0001] * packets, [0.0002] * 10)
        return {(1, 4): ReceivedStream([0.0] * packets, [(number, 0.1) for number in range(first, packets)], lateness)}

    return observe


def fake(monkeypatch: pytest.MonkeyPatch, observer: Observer, findings: list[MachineRequirement] = WORKS) -> None:
    """Replace the machine by a machine with these properties, and the measurement by this function."""
    monkeypatch.setattr(doctor_module, "examine", lambda: findings)
    monkeypatch.setattr(capabilities, "studies", lambda engine: (STUDY,))
    monkeypatch.setattr(capabilities, "in_lab", lambda engine: observer)


def doctor(*options: str) -> Result:
    return CliRunner().invoke(cli.app, ["doctor", "--measure", *options])


def test_table_shows_requested_and_measured_values(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, losing(0.15))
    done = doctor()
    assert done.exit_code == 0
    (row,) = [line.split() for line in done.stdout.splitlines() if "loss 0.15" in line]
    assert row == ["✔", "loss", "0.15", "lost", "15", "%", "15", "13.86", "to", "16.21", "10000"]
    assert "packets took 0.1 ms" in done.stdout
    assert "nftables: 10000 packets for 1 question" in done.stderr


def test_answer_outside_once_is_shown_and_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, losing(0.2, 0.15))
    done = doctor()
    assert done.exit_code == 0
    (first,) = [line.split() for line in done.stdout.splitlines() if "at first" in line]
    assert first == ["at", "first", "20", "18.72", "to", "21.35", "10000"]


def test_answer_outside_twice_gives_status_1(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, losing(0.2, 0.2))
    done = doctor()
    assert done.exit_code == 1
    assert "✘  loss 0.15" in done.stdout


def test_json_has_findings_lateness_and_a_row_for_each_question(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, losing(0.2, 0.15))
    done = doctor("--json")
    found = json.loads(done.stdout)
    assert [finding["name"] for finding in found["findings"]] == ["netem", "nftables", "engine"]
    (engine,) = found["measured"]
    assert engine["engine"] == "nftables"
    assert engine["lateness"]["way"] == {"median_s": 0.0001, "p99_s": pytest.approx(0.0001)}
    (row,) = engine["rows"]
    assert row["low"] < row["asked"] < row["high"]
    assert row.pop("before").keys() == {"measured", "low", "high", "packets"}
    assert {
        "engine",
        "condition",
        "quantity",
        "unit",
        "asked",
        "measured",
        "low",
        "high",
        "packets",
        "ok",
    } == row.keys()


def test_missing_engine_gives_status_3(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, losing(), NOTHING_WORKS)
    done = doctor()
    assert done.exit_code == 3
    assert "install nftables" in done.stdout
    as_json = doctor("--json")
    assert as_json.exit_code == 3
    assert json.loads(as_json.stdout)["measured"] == []


def test_busy_machine_causes_one_sentence_and_status_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def too_busy(study: NetworkStudy, packets: int) -> Mapping[tuple[int, int], ReceivedStream]:
        raise LabError("A receive buffer overflowed")

    fake(monkeypatch, too_busy)
    monkeypatch.setattr(sys, "argv", ["ucp-harness", "doctor", "--measure"])
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)  # the command replaces it
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 3
    assert "A receive buffer overflowed" in capsys.readouterr().err

"""Create runs to export: a simulated run without telemetry, and a telemetry log for it. All tests share one run."""

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from sitl._tlog import TelemetryLog
from tests.harness.command import harness, write_scenario

ABOUT: dict[str, Any] = {
    "network": {"loss": 0.1, "radio": {"log_distance": {}}},
    "timeline": [
        {"at_s": 50, "partition": [[1], [2, 3]]},
        {"at_s": 100, "heal": True},
        {"at_s": 120, "reboot": [2], "down_s": 10, "disk": "kept"},
    ],
    "flight": [{"vehicles": [1], "plan": [{"take_off": 20}, {"go_to": [50, 300]}, {"land": True}]}],
    "events": {"mean_s": 4},
}


def play(directory: Path) -> Path:
    """Play a run of three agents. One agent flies away and loses contact, and another agent reboots."""
    out = directory / "run"
    ended = harness("run", write_scenario(directory, duration_s=180, **ABOUT), "--backend", "sim", "--out", out)
    assert ended.returncode in (0, 1), ended.stderr
    return out


def add_telemetry(run: Path, vehicle: int = 1, seconds: int = 30) -> Path:
    """Add the telemetry of the first seconds of a mission that begins in 1970."""
    directory = run / "vehicles" / str(vehicle)
    directory.mkdir(parents=True, exist_ok=True)
    coder = mavlink.MAVLink(None, srcSystem=vehicle)
    log = TelemetryLog(directory / "telemetry.tlog")
    for second in range(seconds):
        for message in (
            mavlink.MAVLink_attitude_message(1000 * second, 0.25, float("nan"), 0, 0, 0, 0),
            mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_ERROR, f"second {second}".encode()),
        ):
            log.write(1_000_000 * second, message.pack(coder))
    log.close()
    return directory / "telemetry.tlog"


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = play(tmp_path_factory.mktemp("export"))
    add_telemetry(run)
    return run

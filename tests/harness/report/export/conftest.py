"""A run that all formats are made of: it is played once."""

from pathlib import Path

import pytest

from tests.harness.report.export.runs import add_telemetry, play


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = play(tmp_path_factory.mktemp("export"))
    add_telemetry(run)
    return run

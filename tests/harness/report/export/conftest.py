"""Play one run that the tests of all export formats share."""

from pathlib import Path

import pytest

from tests.harness.report.export.runs import add_telemetry, play


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = play(tmp_path_factory.mktemp("export"))
    add_telemetry(run)
    return run

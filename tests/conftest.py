"""Settings for all tests, and the pytest markers `lab`, `docker` and `uml`.

A test with the marker `lab` needs private network namespaces, one with `docker` needs a Docker engine, and one with
`uml` needs User Mode Linux. On other machines, the test is skipped with a reason.
"""

import os
import signal

import pytest
from hypothesis import HealthCheck, settings

from tests.machine import require, require_docker, require_uml

# Hypothesis must not fail a test because the machine is slow.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

# On a build server, pytest prints longer reports of failures. Tests of the pytest plugin compare the short reports.
for _build_server in ("CI", "BUILD_NUMBER"):
    os.environ.pop(_build_server, None)

# If this process ignores SIGINT (`make test &` in a script, some build servers), its children inherit this, and tests
# that interrupt them fail. A handler that does nothing gives the children the default behaviour.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, lambda *_: None)


@pytest.fixture(autouse=True)
def _machine_can(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("lab"):
        require(None)
    if request.node.get_closest_marker("docker"):
        require_docker()
    if request.node.get_closest_marker("uml"):
        require_uml()

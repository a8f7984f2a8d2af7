"""Tests marked `lab` need private network namespaces, `docker` an engine, `uml` User Mode Linux.

They are skipped where there is none, and say why.
"""

import os
import signal

import pytest
from hypothesis import HealthCheck, settings

from tests.machine import require, require_docker, require_uml

# How fast a machine is, is no property of the code.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

# Where a build server says that it is one, pytest tells failures at greater length; tests of pytest read what it tells.
for _build_server in ("CI", "BUILD_NUMBER"):
    os.environ.pop(_build_server, None)

# Where Ctrl-C is ignored (`make test &` in a script, some build servers) children would ignore it too, and tests press
# it. What is handled here, if only by doing nothing, is at its default in them.
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

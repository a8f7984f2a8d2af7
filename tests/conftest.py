"""Tests marked `lab` need private network namespaces, `docker` an engine, `uml` User Mode Linux.

They are skipped where there is none, and say why.
"""

import signal

import pytest
from hypothesis import HealthCheck, settings

from tests.machine import require, require_docker, require_uml

# How fast a machine is, is no property of the code.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

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

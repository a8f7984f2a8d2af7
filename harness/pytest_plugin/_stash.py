"""Define the key under which pytest stores the run of a test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from harness.pytest_plugin._judged_run import RunOfOneTest

TRIAL: pytest.StashKey[RunOfOneTest] = pytest.StashKey()

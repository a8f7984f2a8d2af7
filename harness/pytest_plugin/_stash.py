"""The key under which a test item stores its run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from harness.pytest_plugin._judged_run import Trial

TRIAL: pytest.StashKey[Trial] = pytest.StashKey()

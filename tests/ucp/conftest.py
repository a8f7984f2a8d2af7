"""Fail each test that does not take the branches that it declares."""

from collections.abc import Generator

import pytest

from tests.ucp.branches import declared, recorded


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    with recorded() as taken:
        result = yield
    missing = declared(item.iter_markers()) - taken
    if missing:
        pytest.fail("not taken: " + ", ".join(f"{handler} {branch!r}" for handler, branch in sorted(missing)), False)
    return result

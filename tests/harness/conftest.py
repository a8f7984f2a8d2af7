"""Provide a browser for tests that show a page."""

from collections.abc import Iterator

import pytest

from tests.harness.report.browser import Browser, open_browser


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with open_browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def browser(chromium: Browser) -> Iterator[Browser]:
    with chromium.fresh() as browser:
        yield browser

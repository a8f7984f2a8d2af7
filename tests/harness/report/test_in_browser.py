"""Test the report in a real browser: no error messages, no text cut off, and full use by keyboard."""

from pathlib import Path
from typing import Literal

import pytest

from harness.archive.archive import RunArchive
from harness.report import write_report
from harness.scenario import Scenario
from tests.harness.report.browser import Browser, chromium_or_skip
from tests.harness.report.flights import split_and_rejoin, write_flight
from tests.harness.report.runs import write_run

DISCONNECTED = {agent: [f"{agent}.{n}" for n in range(1, 41)] for agent in (1, 2, 3, 4, 65535)}
TWENTY = {
    agent: ["1.1", "2.1", *(f"{agent % 7 + 1}.{n}" for n in range(2, 14))][: 14 - agent % 3] for agent in range(1, 21)
}

SHOWN = "getComputedStyle(document.querySelector('.{}')).display != 'none'"
LABELS_THAT_DO_NOT_FIT = """
[...document.querySelectorAll('.abridged .chains g')].filter(g => g.querySelector('rect')).flatMap(g =>
  [...g.querySelectorAll('text')].filter(t => {
    const box = g.querySelector('rect').getBBox(), text = t.getBBox();
    return text.x < box.x + 2 || text.x + text.width > box.x + box.width - 2;
  }).map(t => t.textContent))
"""
TAGS_THAT_DO_NOT_FIT = """
[...document.querySelectorAll('.map rect[rx] + text')].filter(t => {
  const box = t.previousElementSibling.getBBox(), text = t.getBBox();
  return text.x < box.x || text.x + text.width > box.x + box.width;
}).map(t => t.textContent)
"""


@pytest.fixture(scope="module", params=["disconnected", "twenty"])
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    chains = {"disconnected": DISCONNECTED, "twenty": TWENTY}[request.param]
    return write_report(RunArchive(write_run(tmp_path_factory.mktemp("run") / "run", chains)))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_page_fits_the_screen_and_logs_no_error(
    browser: Browser, page: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    browser.show(page, width=width, scheme=scheme)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate(LABELS_THAT_DO_NOT_FIT) == []
    ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 26)"}[scheme], "the policy lets the style in"
    assert browser.complaints == []


def test_large_figures_stay_on_one_line(browser: Browser, tmp_path: Path) -> None:
    page = write_report(RunArchive(write_run(tmp_path / "run", {1: "1.1"}, {"figures": {"bytes": 129_526_143}})))
    lines = """(() => { const range = document.createRange();
      range.selectNodeContents(document.querySelector('.tiles dd'));
      return range.getClientRects().length; })()"""
    for width in (360, 1280):
        browser.show(page, width=width, scheme="light")
        assert browser.evaluate(lines) == 1


def test_the_keyboard_unfolds_the_tree_and_folds_it_again(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    assert browser.evaluate(SHOWN.format("abridged"))
    assert not browser.evaluate(SHOWN.format("full"))
    for _ in range(20):
        browser.press("Tab")
        if browser.evaluate("document.activeElement.id") == "every-block-chains":
            break
    browser.press(" ", text=" ")
    assert not browser.evaluate(SHOWN.format("abridged"))
    assert browser.evaluate(SHOWN.format("full"))
    browser.press(" ", text=" ")
    assert browser.evaluate(SHOWN.format("abridged"))
    assert browser.complaints == []


def test_wide_tree_scrolls_inside_its_frame_by_keyboard(browser: Browser, page: Path) -> None:
    browser.show(page, width=360, scheme="light")
    assert browser.evaluate("document.querySelector('.abridged').tabIndex") == 0
    frame, tree = browser.evaluate(
        "[document.querySelector('.abridged').clientWidth, document.querySelector('.abridged').scrollWidth]"
    )
    assert frame <= 360
    assert tree >= frame


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = write_run(tmp_path_factory.mktemp("run") / "run", {agent: ["1.1"] for agent in range(1, 6)})
    network = {"radio": {"hard_range": {"range_m": 250}}}
    timeline = [{"at_s": 500, "kill": [5]}]
    scenario = Scenario.model_validate({"name": "x", "agents": 5, "network": network, "timeline": timeline})
    write_flight(run_dir, scenario, {agent: split_and_rejoin(agent) for agent in range(1, 6)}, 600)
    return write_report(RunArchive(run_dir))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_the_map_fits_the_screen_in_its_colours_and_the_console_is_silent(
    browser: Browser, flown: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    browser.show(flown, width=width, scheme=scheme)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    colour = browser.evaluate("getComputedStyle(document.querySelector('.way.part0')).stroke")
    assert colour == {"light": "rgb(0, 114, 178)", "dark": "rgb(86, 180, 233)"}[scheme]
    dashes = "new Set([...document.querySelectorAll('.way')].map(w => getComputedStyle(w).strokeDasharray)).size"
    assert browser.evaluate(dashes) == 2, "parts also differ by their dashes"
    assert browser.evaluate("document.querySelectorAll('.moments .map').length") == 5
    assert browser.evaluate(TAGS_THAT_DO_NOT_FIT) == []
    assert browser.complaints == []


@pytest.mark.parametrize(("required", "outcome"), [("", pytest.skip.Exception), ("lab,browser", pytest.fail.Exception)])
def test_a_missing_browser_is_a_failure_only_where_one_is_required(
    monkeypatch: pytest.MonkeyPatch, required: str, outcome: type[BaseException]
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("UCP_REQUIRE", required)
    with pytest.raises(outcome, match="no chromium"):
        chromium_or_skip()

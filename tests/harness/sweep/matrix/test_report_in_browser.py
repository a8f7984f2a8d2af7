"""Test the report of a matrix in a real browser: mouse and keyboard lead from a tile to its runs without scripts."""

from pathlib import Path
from typing import Literal

import pytest

from harness.sweep.matrix import matrix_outputs
from harness.sweep.matrix.nights import StoredNights
from tests.harness.report.browser import Browser
from tests.harness.sweep.matrix.stub import matrix, played
from tests.harness.sweep.matrix.test_report import breaks, over

ANCHOR = "loss-0.5-agents-10-sim"
TILE = f"document.querySelector('.of-uniform .tile[href=\"#{ANCHOR}\"]')"
SHOWN = "[...document.querySelectorAll('{}')].filter(one => one.checkVisibility()).map(one => one.{})"
RUNS = SHOWN.format(".runs", "id")
FIGURES = SHOWN.format(".figure h3", "textContent")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("matrix")
    finished = played(matrix(agents=[5, 10], loss=(0.0, 0.15, 0.3, 0.5)), 1, breaks)
    matrix_outputs.write(finished, directory, StoredNights(directory, over(finished, 9).records, ["one is left out"]))
    return directory / "report.html"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_page_fits_the_screen_and_logs_no_error(
    browser: Browser, page: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    browser.show(page, width=width, scheme=scheme)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    darkest = browser.evaluate("getComputedStyle(document.querySelector('.scale .shade-10')).backgroundColor")
    assert darkest == {"light": "rgb(0, 78, 122)", "dark": "rgb(120, 200, 245)"}[scheme]
    line = browser.evaluate("getComputedStyle(document.querySelector('.trend .line')).stroke")
    assert line == {"light": "rgb(0, 114, 178)", "dark": "rgb(86, 180, 233)"}[scheme]
    assert browser.evaluate("performance.getEntriesByType('resource').length") == 0
    assert browser.complaints == []


def test_heatmap_and_panels_fit_a_phone(browser: Browser, page: Path) -> None:
    browser.show(page, width=390, scheme="light")
    right = SHOWN.format(".tile, .one-by-one svg", "getBoundingClientRect().right")
    edges = browser.evaluate(right)
    assert len(edges) == 2 * 4 + 2 * 6
    assert max(edges) <= 390
    boxes = "[...document.querySelectorAll('.one-by-one use')].map(one => one.getBoundingClientRect().width)"
    assert min(browser.evaluate(boxes)) > 300  # each shows a panel


def test_click_on_a_cell_shows_only_its_runs(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    assert browser.evaluate(RUNS) == []
    browser.evaluate(f"{TILE}.scrollIntoView({{block: 'center'}})")
    x, y = browser.evaluate(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({TILE}.getBoundingClientRect())")
    browser.drag((x, y), (x, y))
    assert browser.evaluate(RUNS) == [ANCHOR]
    first = browser.evaluate(f"document.getElementById('{ANCHOR}').querySelector('tbody tr').innerText")
    assert first.split("\t")[0] == "3"
    assert "! failed RuntimeError: </title>" in first
    top = browser.evaluate(f"document.getElementById('{ANCHOR}').getBoundingClientRect().top")
    assert 0 <= top < 100, "it is scrolled to"
    assert browser.complaints == []


def test_keyboard_reaches_a_cell_its_runs_and_the_heatmap_again(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    for _ in range(40):
        browser.press("Tab")
        if browser.evaluate(f"document.activeElement === {TILE}"):
            break
    browser.press("Enter", text="\r")
    assert browser.evaluate(RUNS) == [ANCHOR]
    assert browser.evaluate("document.activeElement.id") == ANCHOR
    browser.press("Tab")
    assert browser.evaluate("document.activeElement.textContent") == "Back to the heatmap"
    browser.press("Enter", text="\r")
    assert browser.evaluate(RUNS) == []
    assert browser.complaints == []


def test_figure_chosen_by_key_is_shown_in_heatmap_and_trend(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    assert browser.evaluate(FIGURES) == ["one chain", "one chain"]
    browser.evaluate("document.getElementById('show-uniform').focus()")
    browser.press("ArrowRight")
    assert browser.evaluate(FIGURES) == ["mutual chain", "mutual chain"]
    assert browser.complaints == []


def test_printed_page_has_heatmaps_chosen_trend_and_chosen_runs(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    with browser.on_paper():
        figures = browser.evaluate(FIGURES)
        assert (len(figures), len(set(figures)), figures[-1]) == (9, 8, "one chain")
        assert browser.evaluate(RUNS) == []
        browser.evaluate(f"location.hash = '{ANCHOR}'")
        assert browser.evaluate(RUNS) == [ANCHOR]

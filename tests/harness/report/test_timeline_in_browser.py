"""Test the timeline in a real browser: zooming by button, key and mouse, and the drawing of messages."""

from pathlib import Path
from typing import Literal

import pytest

from harness.play.progress import SilentProgress
from harness.run.run import run
from tests.harness.report.browser import Browser
from tests.harness.report.test_timeline import TROUBLED
from tests.harness.virtual import scenario

VIEW = "[...document.querySelectorAll('.view')].map(v => v.getAttribute('viewBox').split(' ').map(Number).slice(0, 3))"
PRESS = "document.querySelector('.timeline [data-do={}]').click()"
ARROWS = "document.querySelectorAll('.arrow').length"
SAID = "document.querySelector('.timeline output').textContent"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(scenario(**TROUBLED), 7, tmp_path_factory.mktemp("runs") / "run", SilentProgress(), backend="sim").report


def span(browser: Browser) -> tuple[float, float]:
    """Return the mission seconds at which the pictures begin and end. They must be the same for all pictures."""
    views = browser.evaluate(VIEW)
    assert len(views) == 4
    assert all(view == views[0] for view in views), "lanes and charts share the time axis"
    from_s, _, length_s = views[0]
    return from_s, from_s + length_s


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_page_fits_the_screen_and_logs_no_error(
    browser: Browser, page: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    browser.show(page, width=width, scheme=scheme)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert not browser.evaluate("document.querySelector('.timeline .controls').hidden"), "the policy lets the script in"
    colour = browser.evaluate("getComputedStyle(document.querySelector('.vote')).stroke")
    assert colour == {"light": "rgb(0, 114, 178)", "dark": "rgb(86, 180, 233)"}[scheme]
    assert browser.complaints == []


def test_buttons_zoom_move_and_show_the_whole_run(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    whole = span(browser)
    assert browser.evaluate("document.querySelector('.timeline [data-do=out]').disabled")
    browser.evaluate(PRESS.format("in"))
    nearer = span(browser)
    assert nearer[1] - nearer[0] == pytest.approx((whole[1] - whole[0]) / 1.6)
    browser.evaluate(PRESS.format("later"))
    later = span(browser)
    assert later[0] > nearer[0]
    assert later[1] - later[0] == pytest.approx(nearer[1] - nearer[0])
    for _ in range(9):
        browser.evaluate(PRESS.format("later"))
    assert span(browser)[1] == pytest.approx(whole[1]), "nothing is shown beyond the end"
    browser.evaluate(PRESS.format("all"))
    assert span(browser) == whole
    assert browser.complaints == []


def test_keys_zoom_and_move(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    whole = span(browser)
    for _ in range(40):
        browser.press("Tab")
        if browser.evaluate("document.activeElement.className") == "timeline":
            break
    browser.press("+", text="+")
    nearer = span(browser)
    assert nearer[0] > whole[0]
    assert nearer[1] < whole[1]
    browser.press("ArrowRight")
    assert span(browser)[0] > nearer[0]
    browser.press("ArrowLeft")
    assert span(browser)[0] == pytest.approx(nearer[0])
    browser.press("-", text="-")
    assert span(browser) == pytest.approx(whole)
    browser.press("+", text="+")
    browser.press("Home")
    assert span(browser) == whole
    assert browser.complaints == []


def test_ctrl_wheel_zooms_at_the_pointer_and_plain_wheel_scrolls(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    whole = span(browser)
    wheel = """(() => {{ const plot = document.querySelector('.plot'), box = plot.getBoundingClientRect();
      return plot.dispatchEvent(new WheelEvent('wheel', {{deltaY: -1, ctrlKey: {}, bubbles: true, cancelable: true,
        clientX: box.left + box.width / 4}})); }})()"""
    assert browser.evaluate(wheel.format("false")), "the page may scroll"
    assert span(browser) == whole
    assert not browser.evaluate(wheel.format("true"))
    from_s, until_s = span(browser)
    quarter = whole[1] / 4
    assert (quarter - from_s) / (until_s - from_s) == pytest.approx(0.25, abs=0.01)


def test_dragging_selects_a_period(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    whole = span(browser)
    left, top, width = browser.evaluate(
        """(() => { const plot = document.querySelector('.plot'); plot.scrollIntoView({block: 'center'});
        const box = plot.getBoundingClientRect(); return [box.left, box.top + 5, box.width]; })()"""
    )
    browser.drag((left + width / 2, top), (left + width / 4, top))
    assert span(browser) == pytest.approx((whole[1] / 4, whole[1] / 2), abs=whole[1] / width * 2)
    assert browser.evaluate("document.querySelector('.selected')") is None
    assert browser.complaints == []


def test_messages_appear_when_zoom_separates_them(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    assert browser.evaluate(ARROWS) == 0
    assert "zoom in for " in browser.evaluate(SAID)
    for _ in range(30):
        browser.evaluate(PRESS.format("in"))
        if drawn := browser.evaluate(ARROWS):
            break
    assert 0 < drawn <= 120
    assert f"{drawn} messages heard" in browser.evaluate(SAID)
    title = browser.evaluate("document.querySelector('.arrows g title').textContent")
    assert "agent " in title
    assert ": sent at " in title
    assert browser.evaluate("getComputedStyle(document.querySelector('svg.arrows')).overflow") == "hidden"
    browser.evaluate(PRESS.format("all"))
    assert browser.evaluate(ARROWS) == 0


def test_every_mark_under_the_pointer_has_a_title(browser: Browser, page: Path) -> None:
    browser.show(page, width=1280, scheme="light")
    met = """(() => { const shape = document.querySelector('.view .vote.approved');
      shape.scrollIntoView({block: 'center'});
      const box = shape.getBoundingClientRect();
      return document.elementFromPoint(box.left + 2, box.top + box.height / 2).textContent; })()"""
    assert ": approved" in browser.evaluate(met)
    on_a_chart = """(() => { const box = document.querySelectorAll('.plot')[1].getBoundingClientRect();
      return document.elementFromPoint(box.left + box.width / 2, box.top + 30).textContent; })()"""
    assert "blocks in chain" in browser.evaluate(on_a_chart)

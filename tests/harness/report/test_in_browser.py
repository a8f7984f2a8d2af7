"""Test the report in a real browser: no error messages, no text cut off, and full use by keyboard.

Test the timeline in a real browser: zooming by button, key and mouse, and the drawing of messages.
"""

from pathlib import Path
from typing import Literal

import pytest

from harness.archive.archive import RunArchive
from harness.play.progress import SilentProgress
from harness.report import write_report
from harness.run.run import run
from harness.scenario import Scenario
from tests.harness.report.browser import Browser, chromium_or_skip
from tests.harness.report.flights import split_and_rejoin, write_flight
from tests.harness.report.runs import write_run
from tests.harness.report.test_timeline import TROUBLED
from tests.harness.virtual import scenario

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


def test_keyboard_unfolds_the_tree_and_folds_it_again(browser: Browser, page: Path) -> None:
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
def test_map_fits_the_screen_in_its_colours_and_the_console_is_silent(
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
def test_missing_browser_fails_only_where_one_is_required(
    monkeypatch: pytest.MonkeyPatch, required: str, outcome: type[BaseException]
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("UCP_REQUIRE", required)
    with pytest.raises(outcome, match="no chromium"):
        chromium_or_skip()


VIEW = "[...document.querySelectorAll('.view')].map(v => v.getAttribute('viewBox').split(' ').map(Number).slice(0, 3))"
PRESS = "document.querySelector('.timeline [data-do={}]').click()"
ARROWS = "document.querySelectorAll('.arrow').length"
SAID = "document.querySelector('.timeline output').textContent"


@pytest.fixture(scope="module")
def timeline_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
def test_timeline_fits_the_screen_and_logs_no_error(
    browser: Browser, timeline_page: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    browser.show(timeline_page, width=width, scheme=scheme)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert not browser.evaluate("document.querySelector('.timeline .controls').hidden"), "the policy lets the script in"
    colour = browser.evaluate("getComputedStyle(document.querySelector('.vote')).stroke")
    assert colour == {"light": "rgb(0, 114, 178)", "dark": "rgb(86, 180, 233)"}[scheme]
    assert browser.complaints == []


def test_buttons_zoom_move_and_show_the_whole_run(browser: Browser, timeline_page: Path) -> None:
    browser.show(timeline_page, width=1280, scheme="light")
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


def test_keys_zoom_and_move(browser: Browser, timeline_page: Path) -> None:
    browser.show(timeline_page, width=1280, scheme="light")
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


def test_ctrl_wheel_zooms_at_the_pointer_and_plain_wheel_scrolls(browser: Browser, timeline_page: Path) -> None:
    browser.show(timeline_page, width=1280, scheme="light")
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


def test_dragging_selects_a_period(browser: Browser, timeline_page: Path) -> None:
    browser.show(timeline_page, width=1280, scheme="light")
    whole = span(browser)
    left, top, width = browser.evaluate(
        """(() => { const plot = document.querySelector('.plot'); plot.scrollIntoView({block: 'center'});
        const box = plot.getBoundingClientRect(); return [box.left, box.top + 5, box.width]; })()"""
    )
    browser.drag((left + width / 2, top), (left + width / 4, top))
    assert span(browser) == pytest.approx((whole[1] / 4, whole[1] / 2), abs=whole[1] / width * 2)
    assert browser.evaluate("document.querySelector('.selected')") is None
    assert browser.complaints == []


def test_messages_appear_when_zoom_separates_them(browser: Browser, timeline_page: Path) -> None:
    browser.show(timeline_page, width=1280, scheme="light")
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


def test_every_mark_under_the_pointer_has_a_title(browser: Browser, timeline_page: Path) -> None:
    browser.show(timeline_page, width=1280, scheme="light")
    met = """(() => { const shape = document.querySelector('.view .vote.approved');
      shape.scrollIntoView({block: 'center'});
      const box = shape.getBoundingClientRect();
      return document.elementFromPoint(box.left + 2, box.top + box.height / 2).textContent; })()"""
    assert ": approved" in browser.evaluate(met)
    on_a_chart = """(() => { const box = document.querySelectorAll('.plot')[1].getBoundingClientRect();
      return document.elementFromPoint(box.left + box.width / 2, box.top + 30).textContent; })()"""
    assert "blocks in chain" in browser.evaluate(on_a_chart)

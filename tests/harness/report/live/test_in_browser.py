"""Test the live page in a real browser, for a finished run and for an active one."""

import json
import shutil
import signal
from pathlib import Path

import pytest

from harness.play.progress import SilentProgress
from harness.report.facts import link_qualities
from harness.run.run import run as play
from tests.harness.command import DEADLINE_S
from tests.harness.report.browser import Browser
from tests.harness.report.live.pages import page_of, until
from tests.harness.report.live.runs import film, of_kind, played
from tests.harness.report.live.test_feed import chains_of, late_film, late_run, of_report, reconcile_during_a_vote
from tests.harness.virtual import scenario

HOSTILE = "</title><script>document.title = 'owned'</script><img src=x onerror=\"document.title='owned'\">"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = played(tmp_path_factory.mktemp("watched") / "run")
    record = json.loads((run / "run.json").read_text())
    record["scenario"]["name"] = HOSTILE
    (run / "run.json").write_text(json.dumps(record))
    return run


CHAINS = "Object.fromEntries([...watch.playhead.swarm.agents].map(([id, agent]) => [id, agent.chain]))"


def test_film_plays_forward_and_back_and_escapes_names(browser: Browser, run: Path) -> None:
    with page_of("watch", run) as (process, address):
        for scheme, width in (("dark", 390), ("light", 1280)):
            browser.show(address, width=width, scheme=scheme)  # type: ignore[arg-type]
            until(browser, "watch.story.end")
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
        assert browser.evaluate("document.getElementById('name').textContent") == HOSTILE
        assert "owned" not in browser.evaluate("document.title").split("'")[0]
        assert browser.evaluate("document.querySelectorAll('img').length") == 0
        browser.evaluate("watch.seek(1e9)")
        chains = until(browser, f"watch.playhead.t >= watch.story.until && {CHAINS}")
        assert chains == {str(agent): chain for agent, chain in chains_of(film(run)).items()}
        assert until(browser, "document.querySelectorAll('#verdicts .good').length") >= 6
        browser.evaluate("watch.seek(60)")
        until(browser, "document.getElementById('clock').textContent.includes('in 2 parts: 1 2 | 3 4')")
        early = browser.evaluate(f"Object.values({CHAINS}).map(chain => chain.length)")
        assert max(early) < max(map(len, chains.values()))
        assert until(browser, "document.querySelectorAll('#events li').length") > 3
        assert browser.evaluate("watch.playhead.swarm.links.get('1-3').slice(2).join()") == "1,1"
        assert browser.evaluate("document.getElementById('map').width") > 100
        legend = browser.evaluate("document.getElementById('legend').textContent")
        assert all(words in legend for words in link_qualities())
        assert browser.complaints == []
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0


def test_keyboard_has_all_functions_of_the_mouse(browser: Browser, run: Path) -> None:
    with page_of("watch", run) as (_, address):
        browser.show(address, width=1280, scheme="light")
        until(browser, "watch.story.end")
        browser.evaluate("watch.seek(1e9)")
        until(browser, "document.querySelectorAll('#events button').length > 3")
        assert browser.evaluate("document.getElementById('map-hint').innerText").startswith("Zoom: wheel or +")
        for _ in range(2):
            browser.press("n", "n")
        assert browser.evaluate("document.getElementById('vehicle').textContent").startswith("vehicle 2, a copter")
        browser.press("+", "+")
        until(browser, "d3.zoomTransform(document.getElementById('map')).k > 1.4")
        moved = browser.evaluate("d3.zoomTransform(document.getElementById('map')).x")
        browser.press("ArrowRight", shift=True)
        assert browser.evaluate("d3.zoomTransform(document.getElementById('map')).x") == pytest.approx(moved - 60)
        browser.evaluate("document.getElementById('events').focus()")
        for _ in range(3):
            browser.press("ArrowDown")
        browser.press("ArrowUp")
        second = "document.querySelectorAll('#events button')[1]"
        assert browser.evaluate(f"document.activeElement === {second}")
        before = browser.evaluate("watch.time")
        browser.press("Enter", "\r")
        assert 0 < browser.evaluate("watch.time") < before


def test_page_keeps_a_vote_open_when_a_reconcile_begins(browser: Browser, run: Path, tmp_path: Path) -> None:
    changes, trace = reconcile_during_a_vote(tmp_path)
    with page_of("watch", run) as (_, address):
        browser.show(address, width=1000, scheme="light")
        until(browser, "watch.story.end")
        browser.evaluate(
            "const swarm = watch.story.ahead, history = new swarm.history.constructor(swarm.run);"
            f"for (const change of {json.dumps(changes)}) {{ swarm.apply(change); history.take(change, swarm); }}"
            "window.spans = history.spans.map(span => [span.what, span.from, span.to]); true"
        )
        assert sorted(browser.evaluate("window.spans")) == [list(one[:3]) for one in of_report({1: trace})]


def test_live_page_and_film_show_the_loss_of_the_network(
    browser: Browser, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Receivers record messages late. The partition lasts for a part of the minute."""
    partition = [{"at_s": 50, "partition": [[1, 2, 3], [4, 5, 6]]}, {"at_s": 80, "heal": True}]
    asked = scenario(agents=6, duration_s=150, network={"loss": 0.2}, timeline=partition, events={"mean_s": 4})
    lossy = play(asked, 1, tmp_path / "lossy", SilentProgress(), "sim", delivers_all=True).directory
    stories = {"film": film(lossy), "live": late_film(lossy, tmp_path / "live", lag=1)}
    stories["late"] = late_run(lossy, tmp_path / "late", monkeypatch)
    with page_of("watch", run) as (_, address):
        browser.show(address, width=1000, scheme="light")
        until(browser, "watch.story.end")
        for name, feed_changes in stories.items():
            browser.evaluate(f"window.{name} = new watch.story.constructor()")
            browser.evaluate(f"for (const change of {json.dumps(feed_changes)}) {name}.take(change)")
        late = browser.evaluate("late.shareLost(0, 1000)")
        shares = {name: browser.evaluate(f"[70, 100, 130].map(t => {name}.shareLost(t - 60, t))") for name in stories}
    assert shares["live"] == shares["film"] == [pytest.approx(0.2, abs=0.04)] * 3
    assert late == pytest.approx(0.2, abs=0.05), "messages that were left out are not lost"


def test_film_of_a_killed_run_reports_the_kill(browser: Browser, run: Path, tmp_path: Path) -> None:
    killed = tmp_path / "run"
    shutil.copytree(run, killed)
    (killed / "run.json").unlink()
    with page_of("watch", killed) as (_, address):
        browser.show(address, width=1000, scheme="light")
        until(browser, "watch.story.end")
        assert browser.evaluate("document.getElementById('status').textContent") == "did not end normally"
    assert of_kind("end", film(killed))[0][1]["outcome"] == "running"

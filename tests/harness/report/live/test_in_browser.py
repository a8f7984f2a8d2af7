"""The page in a real browser: a film of a finished run, and a run while it goes on."""

import json
import shutil
import signal
from pathlib import Path

import pytest

from harness.report.facts import link_qualities
from tests.harness.command import DEADLINE_S
from tests.harness.report.browser import Browser
from tests.harness.report.live.pages import page_of, until
from tests.harness.report.live.runs import film, of_kind, played
from tests.harness.report.live.test_feed import chains_of, of_report, reconcile_during_a_vote

HOSTILE = "</title><script>document.title = 'owned'</script><img src=x onerror=\"document.title='owned'\">"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = played(tmp_path_factory.mktemp("watched") / "run")
    record = json.loads((run / "run.json").read_text())
    record["scenario"]["name"] = HOSTILE
    (run / "run.json").write_text(json.dumps(record))
    return run


CHAINS = "Object.fromEntries([...watch.playhead.swarm.agents].map(([id, agent]) => [id, agent.chain]))"


def test_a_film_plays_forward_and_back_and_takes_names_as_text(browser: Browser, run: Path) -> None:
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


def test_page_keeps_a_vote_open_when_a_reconcile_begins(browser: Browser, run: Path, tmp_path: Path) -> None:
    changes, trace = reconcile_during_a_vote(tmp_path)
    with page_of("watch", run) as (_, address):
        browser.show(address, width=1000, scheme="light")
        until(browser, "watch.story.end")
        browser.evaluate(
            "const history = new watch.story.ahead.history.constructor(), swarm = watch.story.ahead;"
            f"for (const change of {json.dumps(changes)}) {{ swarm.apply(change); history.take(change, swarm); }}"
            "window.spans = history.spans.map(span => [span.what, span.from, span.to]); true"
        )
        assert sorted(browser.evaluate("window.spans")) == [list(one[:3]) for one in of_report({1: trace})]


def test_a_film_of_a_run_that_was_killed_says_so(browser: Browser, run: Path, tmp_path: Path) -> None:
    killed = tmp_path / "run"
    shutil.copytree(run, killed)
    (killed / "run.json").unlink()
    with page_of("watch", killed) as (_, address):
        browser.show(address, width=1000, scheme="light")
        until(browser, "watch.story.end")
        assert browser.evaluate("document.getElementById('status').textContent") == "did not end normally"
    assert of_kind("end", film(killed))[0][1]["outcome"] == "running"

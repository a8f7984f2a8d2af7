"""Test stories: the plugin plays them and compares the run with their text, or rewrites the text on request."""

import json
import shlex
import sys
from pathlib import Path

import pytest

from harness.errors import ScenarioError
from harness.report.stories.story_file import read_story
from tests.harness.unsupported import refusing_to_start
from tests.pytest_plugin.inner import no_internals, run, run_directories

pytest_plugins = "pytester"

TOLD = """\
# Somebody misses a commit.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

1 s: 1 logs
8 s: 1 does not reach 3
15 s: 1 reaches 3 again

# It notices when it votes.
20 s: 3 logs
60 s: end
"""


def write(pytester: pytest.Pytester, text: str, file: str = "missed.story") -> Path:
    path = pytester.path / file
    path.write_text(text)
    return path


def written(pytester: pytest.Pytester, text: str = TOLD) -> Path:
    """Write a story together with the reactions of the agents."""
    path = write(pytester, text)
    run(pytester, path, "--ucp-rewrite").assert_outcomes(passed=1)
    return path


def test_reactions_are_written_below_sentences(pytester: pytest.Pytester) -> None:
    text = written(pytester).read_text()
    assert [line for line in text.splitlines() if line and not line.startswith(" ")] == [
        line for line in TOLD.splitlines() if line
    ]
    assert (
        "  1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on incep" in text
    )
    assert "(1.1 on inception), not to 3\n" in text
    assert "      2           6  Receive Commit Block from 1: committed; chain +1.1\n" in text
    assert (
        "      1 2         3  Receive Request Add Block from 3: disapprove -> Block Add Response (3.1: disapprove)\n"
        in text
    )
    assert text.endswith("    chains\n      inception 1.1 3.1  (1 2 3)\n")
    run(pytester).assert_outcomes(passed=1)
    assert not run_directories(pytester)


def test_rewriting_a_correct_story_changes_nothing(pytester: pytest.Pytester) -> None:
    text = written(pytester).read_text()
    assert written(pytester, text).read_text() == text


def test_deviating_agent_fails_with_the_differing_lines(pytester: pytest.Pytester) -> None:
    path = written(pytester)
    wrong = path.read_text().replace("agents: 3\n", "agents: 3\nquirks: {ignore_commit: {agents: [2], value: 1.0}}\n")
    path.write_text(wrong)
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "agents deviate from the story; if the agents are right, --ucp-rewrite rewrites the story",
            "--- missed.story, as written",
            "+++ as played",
            "-      2           6  Receive Commit Block from 1: committed; chain +1.1",
            "+      2           6  Receive Commit Block from 1: ignored by quirk",
            "report: *",
        ]
    )
    no_internals(result)
    assert path.read_text() == wrong


def test_story_that_needs_virtual_time_is_skipped_on_processes(pytester: pytest.Pytester) -> None:
    fates = 'fates: [{message: Commit Block, block: "1.1", receiver: 3, drop: true}]\n'
    path = written(pytester, TOLD.replace("agents: 3\n", "agents: 3\n" + fates))
    result = run(pytester, path, "--ucp-backend", "process", "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["*`fates` needs virtual time: use --backend sim"])


@pytest.mark.lab
def test_processes_follow_the_story(pytester: pytest.Pytester) -> None:
    path = written(pytester)
    agent = f"{shlex.quote(sys.executable)} -P -m ucp.node"
    run(pytester, path, "--ucp-backend", "process", "--ucp-agent", agent).assert_outcomes(passed=1)
    kept = pytester.path / "kept"
    mixed = ("--ucp-agent", f"2={agent}", "--ucp-keep", kept)
    run(pytester, path, "--ucp-backend", "process", *mixed).assert_outcomes(passed=1)
    (record,) = kept.glob("*/run.json")
    commands = {agent: left["command"] for agent, left in json.loads(record.read_text())["agents"].items()}
    assert commands["2"] == [sys.executable, "-P", "-m", "ucp.node"]


def test_story_files_of_other_tools_are_not_collected(pytester: pytest.Pytester) -> None:
    write(pytester, "Scenario: trader is alerted\nGiven a stock\n", "trader.story")
    (pytester.path / "binary.story").write_bytes(b"\xff\xfe1 s: x\n")
    run(pytester).assert_outcomes()


def test_trace_with_unknown_words_is_not_compared(pytester: pytest.Pytester) -> None:
    agent = pytester.makepyfile(
        agent="""
        import sys
        from ucp.node import main
        from ucp.trace import HandlerRun

        known = HandlerRun.to_line
        HandlerRun.to_line = lambda run: known(run).replace('"branch":"approve"', '"branch":"agrees"')
        sys.exit(main(sys.argv[1:]))
        """
    )
    command = f"2={shlex.quote(sys.executable)} -P {shlex.quote(str(agent))}"
    result = run(pytester, written(pytester), "--ucp-agent", command, "-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(
        ["*cannot be compared with the story: unknown branch 'agrees' of receive_request_add_block in the *"]
    )


@pytest.mark.lab
def test_unsupported_feature_skips_the_test(pytester: pytest.Pytester) -> None:
    agent = refusing_to_start(pytester.path / "agent")
    pytester.makepyfile("def test_waits(swarm):\n    swarm.run_for(60)\n")
    command = f"2={shlex.quote(str(agent))}"
    result = run(pytester, written(pytester), ".", "--ucp-backend", "process", "--ucp-agent", command, "-rs")
    result.assert_outcomes(skipped=2)
    result.stdout.fnmatch_lines(["SKIPPED * not supported by agent 2 (*/agent): mine has no telemetry"] * 2)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (["9=my_agent"], "agent_command names vehicle 9, which is not on the roster: use one of 1, 2, 3"),
        (["2=my_agent", "2=yours"], "--ucp-agent names two programs for 2"),
        (["2="], "--ucp-agent is empty: name a program"),
    ],
)
def test_impossible_agent_option_is_reported_in_one_sentence(
    pytester: pytest.Pytester, asked: list[str], sentence: str
) -> None:
    options = [word for agent in asked for word in ("--ucp-agent", agent)]
    result = run(pytester, write(pytester, TOLD), *options)
    assert sentence in result.stdout.str() + result.stderr.str()
    no_internals(result)


def test_foreign_agents_follow_the_story_in_virtual_time(pytester: pytest.Pytester) -> None:
    path = written(pytester)
    run(pytester, path, "--ucp-agent", f"2={shlex.quote(sys.executable)} -P -m ucp.node").assert_outcomes(passed=1)
    result = run(pytester, path, "--ucp-agent", "./my_agent --quick")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["`agent_command` of agent 1: ./my_agent is not a program*"])
    no_internals(result)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("agents: 3\n", "it has no sentence, such as `1 s: 1 logs`"),
        ("1 s: 1 logs\n", "it has no end: add a last sentence such as `60 s: end`"),
        ("1 s: 1 sings\n", "line 1: '1 sings' is not a sentence of a story: use `1 2 log`"),
        (
            "1 s: 1 logs\n\nand then\n2 s: end\n",
            "line 3: 'and then' is not a sentence: start it with its mission second",
        ),
        ("9 s: 1 logs\n2 s: end\n", "line 2: 2 s is before 9 s of an earlier sentence"),
        ("9 s: end\n10 s: 1 logs\n", "line 2: a sentence follows the end"),
        (
            "agents: [\n1 s: end\n",
            "the keys before its first sentence are wrong: not YAML at line ",
        ),
        ("- 3\n1 s: end\n", "the text before its first sentence must be keys of a scenario with their values"),
        ("timeline: []\n1 s: end\n", "`timeline` is set by the sentences of the story: leave it out"),
        ("agents: 3\n1 s: kill 7\n2 s: end\n", "line 2: kill names vehicle 7, which is not on the roster"),
        (
            "agents: 3\n\n1 s: 1 logs 900 bytes\n2 s: end\n",
            "line 3: by `settings.max_event_bytes` an event has",
        ),
        ("agents: 2001-02-30\n1 s: end\n", "not YAML: an invalid value: day is out of range for month"),
        ("agents: " + "[" * 99 + "\n1 s: end\n", "not YAML at line 1: it is nested too deeply"),
        ("1 s: {kill: [1}\n2 s: end\n", "line 1: '{kill: [1}' is not an entry of a timeline in YAML"),
        ("1 s: {at_s: 3}\n2 s: end\n", "is not an entry of a timeline without `at_s`"),
    ],
)
def test_mistake_in_a_story_is_reported_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "wrong.story"
    path.write_text(text)
    with pytest.raises(ScenarioError) as error:
        read_story(path)
    assert sentence in str(error.value) and str(error.value).startswith(f"{path}: ")

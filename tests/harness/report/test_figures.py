"""Test that each figure of the thesis has a story in tests/stories, and that the guide names each story."""

import re
from pathlib import Path

import pytest

from harness.archive.archive import RunArchive
from harness.play.progress import SilentProgress
from harness.report.stories.narration import StoryWriter
from harness.report.stories.story_file import Story, read_story
from harness.run.run import run
from ucp.agent import HANDLERS
from ucp.handler import EventHandler

REPOSITORY = Path(__file__).parents[3]
STORIES = REPOSITORY / "tests/stories"
PAGE = (REPOSITORY / "docs/how-to/write-a-story.md").read_text()
IN_NO_FIGURE = {
    "receive_vote_add_block": {"another round", "counted already"},
    "receive_commit_block": {"held already"},
    "receive_phase_1_response": {"counted already"},
    "reconcile_phase_1_timer_expiration": {"at inception"},
    "receive_response_next_in_sequence": {"counted already"},
    "reconcile_phase_3": {"held already"},
    "reconcile_finalize": {"asked who follows"},
}
"""Branches of handlers that no figure of the thesis shows. The harness adds them for cases that the thesis does not
cover.
"""


def story_with_answers(story: Story, directory: Path, seed: int = 1) -> str:
    """Play the story in virtual time, and return its text with the reactions of the agents in this run."""
    run(story.in_virtual_time, seed, directory, SilentProgress(), "sim", delivers_all=True)
    narrator = StoryWriter(RunArchive(directory).traces, story.scenario.roster)
    return story.with_answers([narrator.answer(section) for section in story.sections])


def test_each_figure_has_a_story_and_the_page_names_it() -> None:
    figures = ["3_02", *(f"3_{number:02}" for number in range(4, 24)), *(f"4_{number}" for number in range(1, 8))]
    stories = sorted(STORIES.glob("*.story"))
    assert [path.name[len("figure_") :][:4].rstrip("_") for path in stories] == figures
    rows = re.findall(r"^\| (\d\.\d+) .* \| \[(\w+)\]\(\.\./\.\./tests/stories/\2\.story\) \|$", PAGE, re.MULTILINE)
    assert rows == [
        (figure.replace("_0", ".").replace("_", "."), path.stem) for figure, path in zip(figures, stories, strict=True)
    ]


@pytest.mark.parametrize("handler", HANDLERS.values(), ids=lambda handler: handler.name)
def test_story_of_a_handler_takes_every_branch_of_its_figure(handler: EventHandler[...]) -> None:
    text = (STORIES / f"figure_3_{handler.algorithm + 3:02}_{handler.name}.story").read_text()
    title = handler.title.partition(" ")[2]
    lines = re.findall(rf"^      [\d ]+ {handler.algorithm}  {title}[^:]*: (.*)$", text, re.MULTILINE)
    taken = {
        branch
        for branch in handler.branches
        for line in lines
        if re.search(rf"(^|, ){re.escape(branch)}(,|;| ->|$)", line)
    }
    assert {*handler.branches} - taken == IN_NO_FIGURE.get(handler.name, set())


def test_example_of_the_documentation_is_reproduced(tmp_path: Path) -> None:
    example = re.search(r"```text\n(.*?)```", PAGE, re.DOTALL)
    assert example is not None
    path = tmp_path / "example.story"
    path.write_text(example[1])
    assert story_with_answers(read_story(path), tmp_path / "run") == example[1]


def test_order_of_equal_receivers_does_not_change_the_story(tmp_path: Path) -> None:
    text = (STORIES / "figure_3_14_reconcile_phase_1_timer_expiration.story").read_text()
    varied = text.replace("agents: 3\n", "agents: 3\nnetwork: {delay: {mean_s: 0.2, jitter_s: 0.19}}\n")
    path = tmp_path / "varied.story"
    path.write_text(varied)
    story = read_story(path)
    assert {story_with_answers(story, tmp_path / str(seed), seed) for seed in range(1, 6)} == {varied}


@pytest.mark.parametrize(
    ("figure", "quirk", "difference"),
    [
        ("3_09_receive_commit_block", "ignore_commit: 1.0", "Receive Commit Block from 1: ignored by quirk"),
        ("3_18_reconcile_phase_2_timer_expiration", "crash_on_tie: true", "Phase 2 Timer Expiration: crashed by quirk"),
        ("3_15_reconcile_phase_2", "early_phase3_expiry: true", "Reconcile Phase 3 Timer Expiration: gave up"),
    ],
)
def test_wrong_agent_changes_the_story(tmp_path: Path, figure: str, quirk: str, difference: str) -> None:
    right = (STORIES / f"figure_{figure}.story").read_text()
    wrong = right.replace("\nagents:", f"\nquirks: {{{quirk}}}\nagents:")
    path = tmp_path / "wrong.story"
    path.write_text(wrong)
    played = story_with_answers(read_story(path), tmp_path / "run")
    assert difference in played and difference not in wrong


@pytest.mark.parametrize("path", sorted(STORIES.glob("*.story")), ids=lambda path: path.stem)
def test_sentences_do_not_coincide_with_the_end_of_a_timer(path: Path) -> None:
    """If two inputs are simultaneous, their order depends on chance in runs with real processes."""
    text = path.read_text()
    printed_at = {*re.findall(r"^(\d+) s: ", text, re.MULTILINE)}
    instants = re.split(r"^    at (\d+) s\n", text, flags=re.MULTILINE)[1:]
    ended_at = {at for at, lines in zip(instants[::2], instants[1::2], strict=True) if "Timer Expiration:" in lines}
    assert not printed_at & ended_at

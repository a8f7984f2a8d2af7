"""Test that no marks of the chain tree overlap, and that every label fits."""

import itertools
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.exports import name_blocks
from harness.report.chain_tree import CHARACTER_WIDTH, ChainTreeLayout, PlacedMark, chain_tree, lay_out, marks
from tests.harness.report.runs import Chains, exports

Box = tuple[float, float, float, float]

BLOCKS = [f"{agent_id}.{ordinal}" for agent_id in (1, 2, 300, 65535) for ordinal in range(1, 6)]
LINK_TURN = 11


def layout(chains: Chains, *, abridged: bool = True) -> ChainTreeLayout:
    read = exports(chains)
    return lay_out(marks(chain_tree(read), name_blocks(read), abridged=abridged))


def box(placed: PlacedMark) -> Box:
    return placed.x - placed.width / 2, placed.y, placed.x + placed.width / 2, placed.y + placed.height


def overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def assert_readable(drawn: ChainTreeLayout) -> None:
    placed_marks = list(drawn.root.walk())
    boxes = [box(placed) for placed in placed_marks]
    for one, other in itertools.combinations(boxes, 2):
        assert not overlap(one, other)
    for left, top, right, bottom in boxes:
        assert left >= 0
        assert top >= 0
        assert right <= drawn.width
        assert bottom <= drawn.height
    for below in placed_marks:
        crossings: list[Box] = []
        for child in below.children:
            assert child.y + child.height < below.y, "time goes up"
            ends = sorted((below.x, child.x))
            crossings.append((ends[0], below.y - LINK_TURN, ends[1], below.y - LINK_TURN + 0.1))
        if below.beside:
            middle = below.y + below.height / 2
            start, end = below.x + below.width / 2, below.beside.x - below.beside.width / 2
            assert start < end
            crossings.append((start + 0.1, middle, end - 0.1, middle + 0.1))
        for link in crossings:
            assert not any(overlap(link, other) for other in boxes), "a link runs through a box"


@st.composite
def swarms(draw: st.DrawFn) -> dict[int, list[str]]:
    """Draw random chains that share a common beginning."""
    agent_ids = draw(st.lists(st.sampled_from([1, 2, 3, 4, 5, 6, 7, 300, 301, 302, 65535]), min_size=1, unique=True))
    common = draw(st.permutations(BLOCKS))
    chains = {}
    for agent_id in agent_ids:
        beginning = common[: draw(st.integers(0, len(BLOCKS)))]
        rest = [name for name in BLOCKS if name not in beginning]
        own = draw(st.lists(st.sampled_from(rest), unique=True, max_size=6)) if rest else []
        chains[agent_id] = beginning + own
    return chains


@given(swarms(), st.booleans())
def test_no_boxes_overlap_and_no_link_runs_through_one(chains: dict[int, list[str]], abridged: bool) -> None:
    assert_readable(layout(chains, abridged=abridged))


@pytest.mark.parametrize("abridged", [True, False])
@pytest.mark.parametrize(
    "chains",
    [
        {agent: [f"{agent}.{n}" for n in range(1, 41)] for agent in range(1, 6)},
        {agent: [f"1.{n}" for n in range(1, agent)] for agent in range(2, 22)},
        {agent: [f"1.{n}" for n in range(1, 1 + agent // 7)] for agent in range(1, 101)},
        {agent: ["1.1", f"{agent}.2", f"{agent % 3 + 1}.3"] for agent in range(1, 21)},
        {agent: ["1.1"] if agent % 2 else ["2.1", "2.2", f"{agent}.3"] for agent in range(1, 101)},
    ],
    ids=["disconnected", "each ends one block later", "a hundred agents", "twenty branches", "a fan over a tall oval"],
)
def test_large_swarms_are_readable(chains: dict[int, list[str]], abridged: bool) -> None:
    assert_readable(layout(chains, abridged=abridged))


def test_labels_of_the_largest_ids_fit_their_boxes() -> None:
    names = [f"65535.{n}" for n in range(9998, 10002)]
    for placed in layout({65535: names, 65534: names[:2]}).root.walk():
        for line in placed.mark.lines:
            assert len(line) * CHARACTER_WIDTH < placed.width


def test_the_majoritys_chain_goes_straight_up() -> None:
    drawn = layout({1: "1.1 1.2", 2: "1.1 2.1 3.1", 3: "1.1 2.1 3.1", 4: "1.1 2.1", 5: "1.1"})
    trunk = {
        placed.x for placed in drawn.root.walk() if placed.mark.lines[0] in ("inception block", "1.1", "2.1", "3.1")
    }
    assert len(trunk) == 1


def test_five_branches_fit_a_phone() -> None:
    chains = {agent: [f"{agent}.{n}" for n in range(1, 41)] for agent in range(1, 6)}
    assert layout(chains).width <= 318


def test_a_tree_of_ten_thousand_blocks_is_laid_out_in_seconds() -> None:
    chains = {agent: [f"{agent}.{n}" for n in range(1, 201)] for agent in range(1, 51)}
    read = exports(chains)
    started = time.process_time()
    lay_out(marks(chain_tree(read), name_blocks(read), abridged=False))
    assert time.process_time() - started < 5

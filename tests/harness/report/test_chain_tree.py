"""Test the tree of chains. Chains in it agree, diverge, or end early.

Test that no marks of the chain tree overlap, and that every label fits.

Test the chain tree as SVG: valid, with a description, and with the name and holders of each block.

Test that agents have different colours, and that labels on these colours are readable.
"""

import itertools
import re
import time
from collections.abc import Iterator
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.exports import name_blocks
from harness.present.colours import contrast, inks
from harness.report.chain_tree import (
    CHARACTER_WIDTH,
    FEWEST_HIDDEN,
    KEPT_AT_EACH_END,
    ChainTreeLayout,
    ChainTreeMark,
    ChainTreeNode,
    PlacedMark,
    chain_tree,
    lay_out,
    marks,
    ranges,
    wrapped,
)
from harness.report.chain_tree_svg import ChainTreePicture
from tests.harness.report.runs import Chains, block, exports


def drawn(chains: Chains, *, abridged: bool = False) -> ChainTreeMark:
    read = exports(chains)
    return marks(chain_tree(read), name_blocks(read), abridged=abridged)


def all_marks(mark: ChainTreeMark) -> Iterator[ChainTreeMark]:
    yield mark
    if mark.beside:
        yield mark.beside
    for child in mark.children:
        yield from all_marks(child)


def texts(mark: ChainTreeMark, kind: str) -> list[str]:
    return [" ".join(found.lines) for found in all_marks(mark) if found.kind == kind]


def only_child(node: ChainTreeNode) -> ChainTreeNode:
    (child,) = node.children.values()
    return child


def test_equal_chains_are_one_branch_with_one_oval() -> None:
    tree = drawn({1: "1.1 2.1", 2: "1.1 2.1", 3: "1.1 2.1"})
    assert texts(tree, "block") == ["inception block", "1.1", "2.1"]
    assert texts(tree, "oval") == ["1\u20133"]


def test_diverging_chains_share_only_their_beginning() -> None:
    tree = chain_tree(exports({1: "1.1 2.1", 2: "1.1 2.1", 3: "1.1 3.1"}))
    shared = only_child(tree)
    assert shared.holders == [1, 2, 3]
    assert [child.holders for child in shared.children.values()] == [[1, 2], [3]]
    assert [child.ends for child in shared.children.values()] == [[1, 2], [3]]


def test_chain_that_ends_inside_another_has_its_oval_beside_the_block() -> None:
    tree = drawn({1: "1.1 2.1 3.1", 2: "1.1 2.1", 3: "1.1 2.1 3.1"})
    beside = {mark.lines[0]: mark.beside.lines for mark in all_marks(tree) if mark.beside}
    assert beside == {"2.1": ["2"]}
    assert sorted(texts(tree, "oval")) == ["1, 3", "2"]


def test_block_after_different_histories_is_on_both_branches() -> None:
    tree = drawn({1: "1.1 2.1 3.1", 2: "1.1 3.1 2.1"})
    assert sorted(texts(tree, "block")) == ["1.1", "2.1", "2.1", "3.1", "3.1", "inception block"]


def test_agents_without_a_block_have_their_oval_at_the_inception_block() -> None:
    assert texts(drawn({1: "", 2: ""}), "oval") == ["1, 2"]
    apart = drawn({1: "1.1", 2: ""})
    assert apart.beside is not None
    assert apart.beside.lines == ["2"]


def test_without_exports_there_is_the_inception_block_alone() -> None:
    assert [mark.lines for mark in all_marks(drawn({}))] == [["inception block"]]


def test_long_stretch_is_abridged_with_the_number_of_hidden_blocks() -> None:
    chain = [f"1.{ordinal}" for ordinal in range(1, 36)]
    tree = drawn({1: chain, 2: chain}, abridged=True)
    assert texts(tree, "ellipsis") == ["29 blocks"]
    assert texts(tree, "block") == ["inception block", "1.1", "1.2", "1.3", "1.33", "1.34", "1.35"]
    (ellipsis,) = (mark for mark in all_marks(tree) if mark.kind == "ellipsis")
    assert len(ellipsis.nodes) == 29


def test_short_stretch_is_drawn_without_ellipsis() -> None:
    most = 2 * KEPT_AT_EACH_END + FEWEST_HIDDEN - 1
    assert texts(drawn({1: [f"1.{n}" for n in range(1, most + 1)]}, abridged=True), "ellipsis") == []
    assert texts(drawn({1: [f"1.{n}" for n in range(1, most + 2)]}, abridged=True), "ellipsis") == ["3 blocks"]


def test_blocks_at_which_chains_diverge_or_end_are_never_hidden() -> None:
    chain = [f"1.{ordinal}" for ordinal in range(1, 61)]
    tree = drawn({1: chain, 2: chain[:20], 3: [*chain[:40], "3.1"]}, abridged=True)
    assert {"1.20", "1.21", "1.40", "1.41", "3.1"} <= set(texts(tree, "block"))
    assert texts(tree, "ellipsis") == ["14 blocks"] * 3


def test_chains_longer_than_pythons_stack_are_drawn() -> None:
    chain = [f"1.{ordinal}" for ordinal in range(1, 3001)]
    assert texts(drawn({1: chain}, abridged=True), "ellipsis") == ["2994 blocks"]


def test_three_or_more_agents_in_a_row_are_a_range() -> None:
    assert ranges([5, 1, 2, 3, 6, 65535]) == ["1\u20133", "5", "6", "65535"]


def test_many_agents_are_wrapped_into_even_lines_that_lose_none() -> None:
    parts = [str(agent_id) for agent_id in range(1, 200, 2)]
    lines = wrapped(parts)
    assert " ".join(lines) == ", ".join(parts)
    assert max(map(len, lines)) - min(map(len, lines[:-1])) < 6


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


def test_chain_of_the_majority_goes_straight_up() -> None:
    drawn = layout({1: "1.1 1.2", 2: "1.1 2.1 3.1", 3: "1.1 2.1 3.1", 4: "1.1 2.1", 5: "1.1"})
    trunk = {
        placed.x for placed in drawn.root.walk() if placed.mark.lines[0] in ("inception block", "1.1", "2.1", "3.1")
    }
    assert len(trunk) == 1


def test_five_branches_fit_a_phone() -> None:
    chains = {agent: [f"{agent}.{n}" for n in range(1, 41)] for agent in range(1, 6)}
    assert layout(chains).width <= 318


def test_tree_of_ten_thousand_blocks_is_laid_out_in_seconds() -> None:
    chains = {agent: [f"{agent}.{n}" for n in range(1, 201)] for agent in range(1, 51)}
    read = exports(chains)
    started = time.process_time()
    lay_out(marks(chain_tree(read), name_blocks(read), abridged=False))
    assert time.process_time() - started < 5


SVG = "{http://www.w3.org/2000/svg}"


def picture(chains: Chains) -> ChainTreePicture:
    return ChainTreePicture(exports(chains), inks([*chains, 1, 2, 3, 4, 5, 65535]))


def titles(drawing: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(drawing).iter(f"{SVG}title")]  # noqa: S314 - ours


def test_file_is_valid_xml_without_references() -> None:
    drawing = picture({1: "1.1 2.1", 2: "1.1"}).standalone()
    assert ElementTree.fromstring(drawing).tag == f"{SVG}svg"  # noqa: S314 - ours
    assert set(re.findall(r"https?://[^\"']*", drawing)) == {"http://www.w3.org/2000/svg"}
    assert "href" not in drawing


def test_tooltip_of_a_block_has_name_time_hash_and_holders() -> None:
    drawing = picture({1: "1.1 2.1 3.1", 2: "1.1 3.1", 3: "1.1 3.1"}).draw("full")
    (both, *others) = [title for title in titles(drawing) if title.startswith("3.1")]
    assert block("3.1").block_hash.hex() in both
    assert "made by agent 3" in both
    assert "30.000 s" in both
    assert "in the chain of agents 1\u20133" in both
    assert len(others) == 1, "one box on each branch"
    assert "with this history: agent 1" in both


def test_tooltip_of_an_ellipsis_names_its_hidden_blocks() -> None:
    drawn = picture({1: [f"1.{n}" for n in range(1, 36)]})
    assert drawn.hidden == 29
    assert "1.4 to 1.32, of agent 1" in titles(drawn.draw("abridged"))


def test_description_is_a_text_alternative_for_the_picture() -> None:
    described = picture({1: "1.1 2.1", 2: "1.1", 3: "1.1 2.1"}).description()
    assert described.startswith("agents 1\u20133: all share 1 block, up to 1.1.")
    assert "agent 2 at 1.1" in described
    assert "agents 1, 3 at 2.1" in described


def test_both_forms_can_stand_on_one_page() -> None:
    drawn = picture({1: [f"1.{n}" for n in range(1, 36)]})
    both = str(drawn.draw("abridged") + drawn.draw("full"))
    ids = re.findall(r' id="([^"]*)"', both)
    assert len(ids) == len(set(ids)) == 4


def test_equal_exports_give_the_same_bytes() -> None:
    chains = {3: "1.1 3.1", 1: "1.1 2.1", 2: "1.1"}
    assert picture(chains).standalone() == picture(dict(reversed(chains.items()))).standalone()


def test_thirty_two_agents_have_different_inks() -> None:
    assert len(set(inks(range(1, 33)).values())) == 32


def test_labels_are_readable_on_every_ink() -> None:
    for ink in inks(range(1, 65)).values():
        assert contrast(ink.fill, ink.text) >= 4.5


def test_every_box_stands_out_from_a_light_and_a_dark_page() -> None:
    for ink in inks(range(1, 65)).values():
        for page in ("#ffffff", "#14171a"):
            assert max(contrast(ink.fill, page), contrast(ink.stroke, page)) >= 2.4


def test_colours_depend_on_the_set_of_agents_and_not_on_their_order() -> None:
    assert inks([3, 1, 2]) == inks([1, 2, 3, 3])

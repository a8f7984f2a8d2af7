"""Test the tree of chains. Chains in it agree, diverge, or end early."""

from collections.abc import Iterator

from harness.archive.exports import name_blocks
from harness.report.chain_tree import (
    FEWEST_HIDDEN,
    KEPT_AT_EACH_END,
    ChainTreeMark,
    ChainTreeNode,
    chain_tree,
    marks,
    ranges,
    wrapped,
)
from tests.harness.report.runs import Chains, exports


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


def test_the_same_block_after_different_histories_stands_on_both_branches() -> None:
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


def test_a_stretch_whose_ellipsis_would_save_no_room_is_drawn_in_full() -> None:
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

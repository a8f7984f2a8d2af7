"""Test the order of the blocks in a merged record."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.exports import ExportedBlock
from harness.field.depot.record_lines import mutual_chain, ordered

LETTERS = "abcdefgh"


def blocks(times: dict[str, int]) -> dict[str, ExportedBlock]:
    return {
        name: ExportedBlock.model_construct(
            agent_id=1, timestamp_us=at, event_data="", block_hash=name, chain_hash=None
        )
        for name, at in times.items()
    }


def order(times: dict[str, int], *chains: str) -> str:
    return "".join(ordered(blocks(times), chains))


@pytest.mark.parametrize(
    ("chains", "expected"),
    [
        (["abc", "abc"], "abcd"),
        (["cba", "cb"], "cbad"),  # the mutual chain keeps its order, whatever the timestamps are
        (["ca", "cb"], "cabd"),  # then by timestamp
        (["cba", "d"], "cbad"),  # chains before timestamps; d is last by its timestamp
        (["db", "ac"], "acdb"),  # b comes after d, as in its chain
        (["ab", "ba"], "abcd"),  # contradicting chains: by timestamp
        (["bac", "cab", ""], "abcd"),
        (["", ""], "abcd"),
    ],
)
def test_order_follows_chains_first_and_then_timestamps(chains: list[str], expected: str) -> None:
    assert order({"a": 1, "b": 2, "c": 3, "d": 4}, *chains) == expected


def test_repeated_block_occurs_once() -> None:
    assert order({"a": 1, "b": 2}, "aba", "aba") == "ab"


chain = st.permutations(LETTERS).flatmap(
    lambda letters: st.integers(0, len(letters)).map(lambda length: "".join(letters[:length]))
)


@given(st.lists(chain, min_size=1, max_size=4), st.lists(st.integers(0, 5), min_size=8, max_size=8))
def test_order_has_each_block_once_and_keeps_agreed_orders(chains: list[str], at: list[int]) -> None:
    times = dict(zip(LETTERS, at, strict=True))
    put = order(times, *chains)
    assert sorted(put) == sorted(LETTERS)
    assert put == order(times, *reversed(chains))
    assert put.startswith("".join(mutual_chain(chains)))
    reach = closure(chains)
    in_chains = set("".join(chains)) - set(mutual_chain(chains))
    for below in in_chains:
        for above in in_chains - {below}:
            if above in reach[below] and below not in reach[above]:
                assert put.index(below) < put.index(above)


def closure(chains: Sequence[str]) -> dict[str, set[str]]:
    """Return all blocks that follow each block in any chain, directly or indirectly."""
    after: dict[str, set[str]] = {letter: set() for letter in LETTERS}
    for letters in chains:
        for position, letter in enumerate(letters):
            after[letter] |= set(letters[position + 1 :])
    for _ in LETTERS:
        for letter in LETTERS:
            after[letter] |= set().union(*(after[other] for other in after[letter]))
    return after

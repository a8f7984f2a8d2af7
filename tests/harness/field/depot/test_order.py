"""The order of all blocks of a mission."""

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
        (["cba", "cb"], "cbad"),  # the mutual chain as it is, whatever the clocks say
        (["ca", "cb"], "cabd"),  # then by time
        (["cba", "d"], "cbad"),  # above what chains say, d last by its clock
        (["db", "ac"], "acdb"),  # b after d, for its chain has it so
        (["ab", "ba"], "abcd"),  # a contradiction: by time
        (["bac", "cab", ""], "abcd"),
        (["", ""], "abcd"),
    ],
)
def test_chains_come_first_and_then_clocks(chains: list[str], expected: str) -> None:
    assert order({"a": 1, "b": 2, "c": 3, "d": 4}, *chains) == expected


def test_a_block_that_all_chains_have_twice_is_there_once() -> None:
    assert order({"a": 1, "b": 2}, "aba", "aba") == "ab"


chain = st.permutations(LETTERS).flatmap(
    lambda letters: st.integers(0, len(letters)).map(lambda length: "".join(letters[:length]))
)


@given(st.lists(chain, min_size=1, max_size=4), st.lists(st.integers(0, 5), min_size=8, max_size=8))
def test_every_block_is_there_once_and_no_agreement_is_broken(chains: list[str], at: list[int]) -> None:
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
    """What comes after a block in any chain, or after what does."""
    after: dict[str, set[str]] = {letter: set() for letter in LETTERS}
    for letters in chains:
        for position, letter in enumerate(letters):
            after[letter] |= set(letters[position + 1 :])
    for _ in LETTERS:
        for letter in LETTERS:
            after[letter] |= set().union(*(after[other] for other in after[letter]))
    return after

"""Test the final reconcile of exports by the protocol, without vehicles.

Test the order of the blocks in a merged record.
"""

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.exports import Export, ExportedBlock
from harness.field.depot.consolidation import MergedRecord
from harness.field.depot.depot_reconcile import reconcile
from harness.field.depot.record_lines import mutual_chain, ordered
from harness.field.depot.record_outputs import lines
from harness.run.simulate import simulate
from tests.harness.field.depot.exports import consolidated, document, make_block, write_exports
from tests.harness.field.depot.test_consolidate import read
from tests.harness.virtual import scenario

RUNS = 25


def random_run_exports(seed: int) -> dict[int, Export]:
    """Return the exports of a random run with loss, a partition, kills and power losses."""
    lots = random.Random(seed)
    count = lots.randint(2, 7)
    agents = sorted(lots.sample(range(1, 300), count))
    at_s = iter(sorted(lots.sample(range(20, 540), 5)))
    timeline: list[dict[str, Any]] = [
        {"at_s": next(at_s), "partition": [lots.sample(agents, lots.randint(1, count - 1))]}
    ]
    if lots.random() < 0.5:
        timeline.append({"at_s": next(at_s), "heal": True})
    if count > 2 and lots.random() < 0.5:
        timeline.append({"at_s": next(at_s), "kill": [agents[0]]})
        if lots.random() < 0.5:
            timeline.append({"at_s": next(at_s), "restart": [agents[0]]})
    if lots.random() < 0.5:
        disk = lots.choice(["kept", "lost"])
        timeline.append({"at_s": next(at_s), "reboot": [agents[1]], "down_s": 30, "disk": disk})
    asked = scenario(
        agents=agents,
        duration_s=600,
        network={"loss": lots.choice([0, 0.1, 0.3, 0.6, 1.0])},
        timeline=timeline,
        events={"source": "random", "mean_s": lots.choice([5, 15, 30])},
        settle={"limit_s": lots.choice([1, 60, 1800])},
    )
    return dict(simulate(asked, seed).evidence.exports)


@pytest.mark.parametrize("seed", range(RUNS))
def test_record_of_a_run_is_complete_and_reconciles_to_one_chain(seed: int, tmp_path: Path) -> None:
    from harness.field.depot.collected_exports import collect_exports
    from harness.field.depot.consolidation import consolidate

    exports = random_run_exports(seed)
    record = consolidate(collect_exports([write_exports(tmp_path, exports)]))
    assert record.header.problems == record.header.left_out == []
    assert events_on_record(record) == events_held(exports)
    reconciled = reconcile(record)
    assert reconciled.line.uniform
    chains = {export.chain_of_block_hashes for export in reconciled.exports.values()}
    (chain,) = chains
    assert len(set(chain)) == len(chain)
    assert set(chain) == {block.block_hash for export in exports.values() for block in export.blocks()}
    assert tuple(reconciled.line.chain) == chain
    for agent_id, export in reconciled.exports.items():
        assert export.current_block == exports[agent_id].current_block
        assert export.completed == exports[agent_id].completed
    (*_, last) = read("".join(lines(record, reconciled.line)))
    assert last == reconciled.line


def events_held(exports: dict[int, Export]) -> list[tuple[int, bytes]]:
    """Return each event in any export, together with the agent that logged the event."""
    import base64

    from ucp.events import decode_events

    blocks = {block.block_hash: block for export in exports.values() for block in export.blocks()}
    held = [(block.agent_id, event) for block in blocks.values() for event in decode_events(block.event_bytes)]
    for agent_id, export in exports.items():
        building = base64.b64decode(export.current_block.event_data)
        own = (block for block in blocks.values() if block.agent_id == agent_id)
        if not any(block.event_bytes.startswith(building) for block in own):
            held += [(agent_id, event) for event in decode_events(building)]
    return sorted((agent_id, event.encode()) for agent_id, event in held)


def events_on_record(record: MergedRecord) -> list[tuple[int, bytes]]:
    return sorted((block.line.agent_id, event.encode()) for block in record.blocks for event in block.events)


def test_agents_with_full_deques_reconcile_to_one_chain(tmp_path: Path) -> None:
    chains = [document(agent, f"{agent}.1 {agent}.2", deque=f"{agent}.3", stack=f"{agent}.4") for agent in range(1, 7)]
    reconciled = reconcile(consolidated(tmp_path, *chains))
    assert reconciled.line.uniform
    assert len(reconciled.line.chain) == 24
    assert all(len(vehicle.gained) == 20 for vehicle in reconciled.line.vehicles)


def test_single_vehicle_keeps_its_chain(tmp_path: Path) -> None:
    line = reconcile(consolidated(tmp_path, document(1, "1.1", deque="1.2"))).line
    assert not line.uniform or len(line.chain) == 2


def test_edited_block_is_left_out_of_the_reconcile(tmp_path: Path) -> None:
    import base64

    edited = document(2, "1.1 2.1 2.2")
    edited["chain"][1]["event_data"] = base64.b64encode(make_block(2, 9).event_data).decode()
    line = reconcile(consolidated(tmp_path, document(1, "1.1"), edited)).line
    assert line.uniform
    assert line.chain == [make_block(1, 1).block_hash.hex(), make_block(2, 2).block_hash.hex()]
    (left_out,) = line.left_out
    assert "edited" in left_out


def test_block_of_an_earlier_export_reaches_the_chain(tmp_path: Path) -> None:
    from harness.field.depot.collected_exports import collect_exports
    from harness.field.depot.consolidation import consolidate
    from tests.harness.field.depot.exports import write

    write(tmp_path / "before", document(1, "1.1 1.2", exported_at_us=1))
    write(tmp_path / "after", document(1, "1.3", exported_at_us=2), document(2, "1.3"))
    line = reconcile(consolidate(collect_exports([tmp_path]))).line
    assert line.uniform
    assert set(line.chain) == {make_block(1, number).block_hash.hex() for number in (1, 2, 3)}


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

"""Test `ucp-harness consolidate`: each event occurs once, with the agents that hold it, and lost blocks are listed."""

import base64
import csv
import gzip
import json
import random
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.archive.exports import Export, read_export
from harness.errors import ExportError, FieldError
from harness.field.depot.collected_exports import collect_exports
from harness.field.depot.consolidation import MergedRecord, consolidate
from harness.field.depot.depot_reconcile import reconcile
from harness.field.depot.record_lines import Block, ConsolidatedLine, Event, Header, MissingItem, ReconcileResult
from harness.field.depot.record_outputs import in_words, lines
from tests.harness.command import harness, sentences, write_scenario
from tests.harness.field.depot.exports import DATA, consolidated, document, make_block, names, write
from ucp.block import Block as UcpBlock
from ucp.block import InceptionBlock
from ucp.events import LoggableEvent, decode_events


def read(text: str) -> list[Any]:
    return [ConsolidatedLine.model_validate_json(line).root for line in text.splitlines()]


def written(record: MergedRecord) -> list[Any]:
    return read("".join(lines(record)))


# Each event occurs once


def test_shared_block_occurs_once_with_all_holders(tmp_path: Path) -> None:
    record = consolidated(tmp_path, document(1, "1.1 2.1"), document(2, "1.1 2.1"), document(3, "1.1", deque="3.1"))
    assert names(record) == ["1.1", "2.1", "3.1"]
    first, second, third = (block.line for block in record.blocks)
    assert (first.mutual, second.mutual, third.mutual) == (True, False, False)
    assert (first.holders, second.holders, third.holders) == ([1, 2, 3], [1, 2], [3])
    assert [(held.place, held.position, held.agents) for held in third.held] == [("deque", 1, [3])]
    assert first.agent_id == 1
    chain_hash = read_export(tmp_path / "1.chain.json").chain[0].chain_hash
    assert first.held[0].chain_hash == chain_hash


def test_record_is_written_in_lines_and_read_back(tmp_path: Path) -> None:
    record = consolidated(tmp_path, document(1, "1.1 2.1", building=3), document(2, "1.1", stack="2.1"))
    read_back = written(record)
    assert isinstance(read_back[0], Header)
    assert (read_back[0].blocks, read_back[0].events, read_back[0].mutual_chain) == (3, 7, 1)
    events = [line for line in read_back if isinstance(line, Event)]
    assert len(events) == 7
    for block in (line for line in read_back if isinstance(line, Block)):
        own = [event for event in events if event.block == block.number]
        assert [event.index for event in own] == [*range(block.events)]
        data = b"".join(
            LoggableEvent(event.timestamp_us, event.event_id, base64.b64decode(event.data)).encode() for event in own
        )
        if block.block_hash is not None:
            assert UcpBlock(block.agent_id, block.timestamp_us, data).block_hash.hex() == block.block_hash


def test_current_block_is_listed_unless_a_block_begins_with_it(tmp_path: Path) -> None:
    building = document(1, "1.1")
    building["current_block"]["event_data"] = base64.b64encode(make_block(1, 2).event_data[:13]).decode()
    record = consolidated(tmp_path, building, document(2, "1.1 1.2", building=1))
    assert names(record) == ["1.1", "1.2", "2.unfinished"]
    assert [held.place for held in record.blocks[1].line.held] == ["chain", "current block"]
    assert record.blocks[1].line.holders == [2]
    assert record.header.events == 2 + 2 + 1


def test_unreadable_event_data_is_kept_unchanged(tmp_path: Path) -> None:
    secured = UcpBlock(1, 5, make_block(1, 1).event_data + b"encrypted")
    agent = document(1, "1.1")
    agent["chain"][0].update(
        event_data=base64.b64encode(secured.event_data).decode(), block_hash=secured.block_hash.hex(), timestamp_us=5
    )
    agent["chain"][0]["signature"] = "of a later version"
    record = consolidated(tmp_path, agent)
    (block,) = record.blocks
    assert (block.line.events, base64.b64decode(block.line.unreadable)) == (2, b"encrypted")


# Forks and lost blocks


def test_fork_lists_agents_and_next_blocks(tmp_path: Path) -> None:
    record = consolidated(
        tmp_path,
        document(1, "1.1 2.1 3.1"),
        document(2, "1.1 2.1 3.1 1.2"),
        document(3, "1.1 3.1 2.1"),
        document(4, "1.1"),
    )
    first, second = record.forks
    assert (first.height, first.after) == (1, "1.1")
    assert [(way.agents, way.next) for way in first.ways] == [([1, 2], "2.1"), ([3], "3.1"), ([4], None)]
    assert (second.height, second.after) == (3, "3.1")
    assert [(way.agents, way.next) for way in second.ways] == [([1], None), ([2], "1.2")]


def test_chains_may_fork_at_the_inception_block(tmp_path: Path) -> None:
    (fork,) = consolidated(tmp_path, document(1, "1.1"), document(2, "2.1")).forks
    assert (fork.height, fork.after, fork.after_hash) == (0, None, None)


def test_completed_block_without_holder_is_lost(tmp_path: Path) -> None:
    record = consolidated(tmp_path, document(1, "1.1 1.3", completed="1.1 1.2 1.3"), document(2, "1.1 3.1"))
    (lost,) = record.lost_blocks
    assert (lost.block, lost.block_hash, lost.agents) == ("1.2", make_block(1, 2).block_hash.hex(), [3])
    (missing,) = record.missing
    assert (missing.agent_id, "1 block of it" in missing.why) == (3, True)
    assert [line.block for line in written(record) if isinstance(line, MissingItem)] == ["1.2", None]


def test_roster_comes_from_mission_files_in_the_directory(tmp_path: Path) -> None:
    mission = ("mission", "new", "--agents", "1,2,9", "--initial-data", DATA.decode(), "--out", tmp_path)
    assert harness(*mission).returncode == 0
    record = consolidated(tmp_path, document(1, "1.1"), document(2, "1.1"))
    assert record.header.roster == [1, 2, 9]
    assert [missing.agent_id for missing in record.missing] == [9]
    assert record.header.left_out == []


def test_trace_lists_blocks_of_a_vehicle_without_export(tmp_path: Path) -> None:
    exports = simulate_into(tmp_path / "run")
    (tmp_path / "run" / "agents" / "2.chain.json").unlink()
    record = consolidate(collect_exports([tmp_path / "run"]))
    assert [missing.agent_id for missing in record.missing] == [2]
    assert record.lost_blocks
    held = {block.block_hash for agent_id in (1, 3) for block in exports[agent_id].blocks()}
    assert {lost.block_hash for lost in record.lost_blocks} == {*exports[2].completed} - held
    assert all(lost.agents == [2] for lost in record.lost_blocks)
    names = {block_hash: f"2.{number}" for number, block_hash in enumerate(exports[2].completed, 1)}
    assert all(lost.block == names[str(lost.block_hash)] for lost in record.lost_blocks)


def test_trace_lists_blocks_that_were_lost_with_a_disk(tmp_path: Path) -> None:
    lossy = {"agents": 2, "duration_s": 300, "network": {"loss": 1.0}, "events": {"source": "random", "mean_s": 2}}
    timeline = [{"at_s": 200, "reboot": [2], "down_s": 5, "disk": "lost"}]
    path = write_scenario(tmp_path, **lossy, timeline=timeline)
    harness("run", path, "--backend", "sim", "--out", tmp_path / "run")
    record = consolidate(collect_exports([tmp_path / "run" / "agents"]))
    assert record.missing == []
    assert len(record.lost_blocks) > 2
    assert [lost.block for lost in record.lost_blocks] == [f"2.{n}" for n in range(1, len(record.lost_blocks) + 1)]
    assert f"2.{len(record.lost_blocks) + 1}" in record.names.values()


def simulate_into(directory: Path) -> dict[int, Export]:
    """Write the run directory of three agents that do not receive most of the messages."""
    lossy = {"agents": 3, "duration_s": 400, "network": {"loss": 0.95}, "settle": {"limit_s": 1}}
    path = write_scenario(directory.parent, **lossy, events={"source": "random", "mean_s": 5})
    harness("run", path, "--backend", "sim", "--out", directory)
    return {agent_id: read_export(directory / "agents" / f"{agent_id}.chain.json") for agent_id in (1, 2, 3)}


# Damaged and unrelated files


def test_edited_block_is_reported_under_its_true_hash(tmp_path: Path) -> None:
    edited = document(2, "1.1 2.1")
    edited["chain"][0]["event_data"] = base64.b64encode(make_block(1, 9).event_data).decode()
    record = consolidated(tmp_path, document(1, "1.1 2.1"), edited)
    assert sorted(names(record)) == ["1.1", "1.1 (edited)", "2.1"]
    (problem,) = record.header.problems
    assert "block 1 of its chain" in problem
    (line,) = (block.line for block in record.blocks if "edited" in block.line.name)
    assert line.claimed_hash == make_block(1, 1).block_hash.hex()
    assert line.block_hash != line.claimed_hash
    assert record.header.events == 6


def test_wrong_hash_of_a_good_block_is_reported_and_events_kept(tmp_path: Path) -> None:
    edited = document(2, "1.1 2.1")
    edited["chain"][1]["block_hash"] = "0" * 64
    record = consolidated(tmp_path, document(1, "1.1 2.1"), edited)
    assert record.header.events == 4
    assert "does not match its hash" in record.header.problems[0]
    assert names(record) == ["1.1", "2.1"]
    assert [block.line.claimed_hash for block in record.blocks] == [None, None]
    assert len(reconcile(record).line.chain) == 2


def test_later_export_is_current_and_earlier_blocks_are_kept(tmp_path: Path) -> None:
    write(tmp_path / "before", document(1, "1.1 1.2", exported_at_us=1))
    write(tmp_path / "again", document(1, "1.1", exported_at_us=2, completed="1.1"), document(2, "1.1"))
    record = consolidate(collect_exports([tmp_path]))
    assert names(record) == ["1.1", "1.2"]
    assert [held.place for held in record.blocks[1].line.held] == ["earlier export"]
    assert record.header.distinct_chains == 1
    assert not record.lost
    assert "later" in record.header.remarks[0]


def test_duplicate_file_counts_once_without_a_problem(tmp_path: Path) -> None:
    write(tmp_path / "a", document(1, "1.1"))
    (tmp_path / "b.json").write_text(json.dumps(document(1, "1.1")))
    (tmp_path / "c.json").write_text(json.dumps(document(1, "1.1"), indent=3))
    done = harness("consolidate", tmp_path, tmp_path / "a")
    assert (done.returncode, done.stderr) == (0, "")
    assert "1 block and 2 events" in done.stdout


def test_other_mission_is_reported_and_left_out(tmp_path: Path) -> None:
    write(tmp_path, document(1, "1.1"), document(2, "1.1"), document(7, "7.1 7.2 7.3", data=b"another"))
    record = consolidate(collect_exports([tmp_path]))
    assert names(record) == ["1.1"]
    (sentence,) = record.header.left_out
    assert "7.chain.json" in sentence
    assert InceptionBlock(b"another").block_hash.hex()[:12] in sentence


def test_truncated_export_is_used_up_to_its_end(tmp_path: Path) -> None:
    write(tmp_path, document(1, "1.1"))
    text = json.dumps(document(2, "1.1 2.1 2.2 2.3", deque="2.4"), indent=1)
    where = text.index(make_block(2, 3).block_hash.hex())
    (tmp_path / "2.chain.json").write_text(text[:where])
    record = consolidate(collect_exports([tmp_path]))
    assert names(record) == ["1.1", "2.1", "2.2"]
    (problem,) = record.header.problems
    assert "2.chain.json" in problem
    assert "cut off" in problem


def test_blocks_after_damage_are_used(tmp_path: Path) -> None:
    text = json.dumps(document(2, "2.1 2.2 2.3 2.4", deque="2.5"), indent=1)
    at = text.index(base64.b64encode(make_block(2, 2).event_data).decode()) + 5
    write(tmp_path, document(1, "1.1"))
    (tmp_path / "2.chain.json").write_bytes((text[:at] + '"\0{\xff' + text[at + 9 :]).encode("latin-1"))
    assert {block.line.block_hash for block in consolidate(collect_exports([tmp_path])).blocks} == {
        make_block(*which).block_hash.hex() for which in ((1, 1), (2, 1), (2, 3), (2, 4), (2, 5))
    }


def test_invalid_part_is_reported_and_others_are_used(tmp_path: Path) -> None:
    wrong = document(1, "1.1 1.2 1.3")
    wrong["chain"][1]["timestamp_us"] = "yesterday"
    wrong["idle"] = 7
    record = consolidated(tmp_path, wrong)
    assert [block.line.block_hash for block in record.blocks] == [make_block(1, n).block_hash.hex() for n in (1, 3)]
    assert any("chain.1" in problem for problem in record.header.problems)
    assert [lost.block for lost in record.lost_blocks] == ["1.2"]


def test_gzip_export_is_read(tmp_path: Path) -> None:
    (tmp_path / "1.chain.json").write_bytes(gzip.compress(json.dumps(document(1, "1.1")).encode()))
    assert names(consolidate(collect_exports([tmp_path]))) == ["1.1"]


def test_unrelated_files_are_ignored(tmp_path: Path) -> None:
    write(tmp_path, document(1, "1.1"))
    (tmp_path / "photo.jpg").write_bytes(random.Random(1).randbytes(5000))
    (tmp_path / "notes.json").write_text("[]")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "list.txt").write_text("milk")
    record = consolidate(collect_exports([tmp_path]))
    assert (names(record), record.header.left_out) == (["1.1"], [])


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"\xff", b'{"schema": "ucp-chain-export/9", "agent_id": 1}', b"[" * 10**5]
)
def test_unusable_file_gives_one_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "3.chain.json"
    path.write_bytes(content)
    with pytest.raises(ExportError, match=r"3\.chain\.json"):
        collect_exports([path])
    write(tmp_path, document(1, "1.1"))
    (sentence,) = collect_exports([tmp_path]).left_out
    assert sentence.startswith(f"{path}: ")


def test_missing_path_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(FieldError):
        collect_exports([tmp_path / "nowhere"])


@settings(deadline=None, max_examples=300)
@given(data=st.data())
def test_damage_causes_no_traceback_and_no_invented_event(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    directory = tmp_path_factory.mktemp("damaged")
    text = bytearray(json.dumps(document(2, "1.1 2.1 2.2", deque="2.3", building=2)).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        what = data.draw(st.binary(max_size=6) | st.sampled_from([b"{", b"}", b"]", b'"', b",", b"null", b"1e999"]))
        text[at : at + data.draw(st.integers(0, 40))] = what
    write(directory, document(1, "1.1 2.1"))
    (directory / "2.chain.json").write_bytes(text)
    record = consolidate(collect_exports([directory]))
    assert [*in_words(record)]
    known = {make_block(*which).block_hash.hex() for which in ((1, 1), (2, 1), (2, 2), (2, 3))}
    for block in record.blocks:
        assert block.line.block_hash in known | {None} or block.line.claimed_hash or record.header.problems
    numbers = Counter((line.block, line.index) for line in written(record) if isinstance(line, Event))
    assert all(count == 1 for count in numbers.values())


# The command


def test_command_writes_requested_files_and_overwrites_none(tmp_path: Path) -> None:
    write(tmp_path / "home", document(1, "1.1 2.1"), document(2, "1.1", deque="2.1"))
    options = ("-o", tmp_path / "mission.jsonl", "--csv", tmp_path / "mission.csv", "--reconcile")
    done = harness("consolidate", tmp_path / "home", *options)
    assert (done.returncode, done.stderr) == (0, "")
    *_, last = read((tmp_path / "mission.jsonl").read_text())
    assert isinstance(last, ReconcileResult)
    assert last.uniform
    assert last.chain == [make_block(1, 1).block_hash.hex(), make_block(2, 1).block_hash.hex()]
    for agent_id in (1, 2):
        export = read_export(tmp_path / "mission.reconciled" / f"{agent_id}.chain.json")
        assert export.chain_of_block_hashes == tuple(last.chain)
    with (tmp_path / "mission.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["block"], row["index"]) for row in rows] == [("1.1", "0"), ("1.1", "1"), ("2.1", "0"), ("2.1", "1")]
    again = harness("consolidate", tmp_path / "home", *options)
    assert again.returncode == 2
    assert "exists" in sentences(again.stderr)[0]


def test_exit_status_shows_whether_all_files_were_usable(tmp_path: Path) -> None:
    write(tmp_path / "home", document(1, "1.1"))
    (tmp_path / "home" / "2.chain.json").write_text("{")
    done = harness("consolidate", tmp_path / "home")
    assert done.returncode == 1
    assert len(sentences(done.stderr)) == 1
    assert harness("consolidate", tmp_path / "home" / "2.chain.json").returncode == 2
    assert harness("consolidate", tmp_path / "home", "-o", tmp_path / "x.kml").returncode == 2
    assert harness("consolidate", tmp_path / "home", "--reconcile").returncode == 2
    without_map = harness("consolidate", tmp_path / "home", "--kml", tmp_path / "x.kml")
    assert without_map.returncode == 1
    assert "no vehicle logged a position, so there is no map" in without_map.stdout
    assert not (tmp_path / "x.kml").exists()


def test_logged_position_is_in_the_track_files(tmp_path: Path) -> None:
    from tests.harness.commands.test_chain_command import fly_vehicles
    from tests.harness.mission import write_exports

    write_exports(fly_vehicles(2, 120), tmp_path / "agents")
    done = harness(
        *("consolidate", tmp_path / "agents", "--kml", tmp_path / "x.kml", "--geojson", tmp_path / "x.geojson")
    )
    assert done.returncode == 0
    features = json.loads((tmp_path / "x.geojson").read_text())["features"]
    assert {feature["properties"]["agent"] for feature in features} == {1, 2}
    positions = sum(
        event.event_id == 5
        for agent_id in (1, 2)
        for data in all_data(read_export(tmp_path / "agents" / f"{agent_id}.chain.json"), agent_id)
        for event in decode_events(data)
    )
    assert f"{positions} positions of 2 vehicles" in done.stdout


def all_data(export: Export, agent_id: int) -> list[bytes]:
    """Return the data of all events in an agent's own export."""
    own = [block.event_bytes for block in export.blocks() if block.agent_id == agent_id]
    return [*own, base64.b64decode(export.current_block.event_data)]

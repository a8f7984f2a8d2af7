"""`ucp-harness consolidate`: every event once, who holds what, what was lost with whom."""

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
from harness.field.depot.collected_exports import came_home
from harness.field.depot.consolidation import Consolidation, consolidate
from harness.field.depot.depot_reconcile import reconcile
from harness.field.depot.record_lines import Block, ConsolidatedLine, Event, Header, Lost, Reconciled
from harness.field.depot.record_outputs import in_words, lines
from tests.harness.command import harness, sentences, write_scenario
from tests.harness.field.depot.exports import DATA, brought, document, made, names, write
from ucp.block import Block as UcpBlock
from ucp.block import InceptionBlock
from ucp.events import LoggableEvent, decode_events


def read(text: str) -> list[Any]:
    return [ConsolidatedLine.model_validate_json(line).root for line in text.splitlines()]


def written(record: Consolidation) -> list[Any]:
    return read("".join(lines(record)))


# Every event once


def test_a_block_that_many_hold_is_there_once_with_all_who_hold_it(tmp_path: Path) -> None:
    record = brought(tmp_path, document(1, "1.1 2.1"), document(2, "1.1 2.1"), document(3, "1.1", deque="3.1"))
    assert names(record) == ["1.1", "2.1", "3.1"]
    first, second, third = (block.line for block in record.blocks)
    assert (first.mutual, second.mutual, third.mutual) == (True, False, False)
    assert (first.holders, second.holders, third.holders) == ([1, 2, 3], [1, 2], [3])
    assert [(held.place, held.position, held.agents) for held in third.held] == [("deque", 1, [3])]
    assert first.agent_id == 1
    chain_hash = read_export(tmp_path / "1.chain.json").chain[0].chain_hash
    assert first.held[0].chain_hash == chain_hash


def test_the_record_is_written_line_by_line_and_read_back(tmp_path: Path) -> None:
    record = brought(tmp_path, document(1, "1.1 2.1", building=3), document(2, "1.1", stack="2.1"))
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


def test_what_was_being_built_is_on_record_unless_a_block_begins_with_it(tmp_path: Path) -> None:
    building = document(1, "1.1")
    building["current_block"]["event_data"] = base64.b64encode(made(1, 2).event_data[:13]).decode()
    record = brought(tmp_path, building, document(2, "1.1 1.2", building=1))
    assert names(record) == ["1.1", "1.2", "2.unfinished"]
    assert [held.place for held in record.blocks[1].line.held] == ["chain", "current block"]
    assert record.blocks[1].line.holders == [2]
    assert record.header.events == 2 + 2 + 1


def test_data_that_is_no_run_of_events_is_kept_as_it_is(tmp_path: Path) -> None:
    secured = UcpBlock(1, 5, made(1, 1).event_data + b"encrypted")
    agent = document(1, "1.1")
    agent["chain"][0].update(
        event_data=base64.b64encode(secured.event_data).decode(), block_hash=secured.block_hash.hex(), timestamp_us=5
    )
    agent["chain"][0]["signature"] = "of a later version"
    record = brought(tmp_path, agent)
    (block,) = record.blocks
    assert (block.line.events, base64.b64decode(block.line.unreadable)) == (2, b"encrypted")


# Where chains part, and what was lost


def test_forks_say_who_goes_on_with_what(tmp_path: Path) -> None:
    record = brought(
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


def test_chains_may_part_at_the_inception_block(tmp_path: Path) -> None:
    (fork,) = brought(tmp_path, document(1, "1.1"), document(2, "2.1")).forks
    assert (fork.height, fork.after, fork.after_hash) == (0, None, None)


def test_a_completed_block_that_nobody_has_is_lost(tmp_path: Path) -> None:
    record = brought(tmp_path, document(1, "1.1 1.3", completed="1.1 1.2 1.3"), document(2, "1.1 3.1"))
    (lost,) = record.lost_blocks
    assert (lost.block, lost.block_hash, lost.agents) == ("1.2", made(1, 2).block_hash.hex(), [3])
    (missing,) = record.missing
    assert (missing.agent_id, "1 block of it" in missing.why) == (3, True)
    assert [line.block for line in written(record) if isinstance(line, Lost)] == ["1.2", None]


def test_who_flew_is_known_from_mission_files_beside_the_exports(tmp_path: Path) -> None:
    mission = ("mission", "new", "--agents", "1,2,9", "--initial-data", DATA.decode(), "--out", tmp_path)
    assert harness(*mission).returncode == 0
    record = brought(tmp_path, document(1, "1.1"), document(2, "1.1"))
    assert record.header.roster == [1, 2, 9]
    assert [missing.agent_id for missing in record.missing] == [9]
    assert record.header.left_out == []


def test_what_a_vehicle_had_that_did_not_come_home_its_trace_says(tmp_path: Path) -> None:
    exports = simulate_into(tmp_path / "run")
    (tmp_path / "run" / "agents" / "2.chain.json").unlink()
    record = consolidate(came_home([tmp_path / "run"]))
    assert [missing.agent_id for missing in record.missing] == [2]
    assert record.lost_blocks
    held = {block.block_hash for agent_id in (1, 3) for block in exports[agent_id].blocks()}
    assert {lost.block_hash for lost in record.lost_blocks} == {*exports[2].completed} - held
    assert all(lost.agents == [2] for lost in record.lost_blocks)
    names = {block_hash: f"2.{number}" for number, block_hash in enumerate(exports[2].completed, 1)}
    assert all(lost.block == names[str(lost.block_hash)] for lost in record.lost_blocks)


def simulate_into(directory: Path) -> dict[int, Export]:
    """The run directory of three agents that hear little of each other."""
    lossy = {"agents": 3, "duration_s": 400, "network": {"loss": 0.95}, "settle": {"limit_s": 1}}
    path = write_scenario(directory.parent, **lossy, events={"source": "random", "mean_s": 5})
    harness("run", path, "--backend", "sim", "--out", directory)
    return {agent_id: read_export(directory / "agents" / f"{agent_id}.chain.json") for agent_id in (1, 2, 3)}


# Whatever has become of the files


def test_an_edited_block_is_told_and_not_taken_for_the_one_whose_hash_it_has(tmp_path: Path) -> None:
    edited = document(2, "1.1 2.1")
    edited["chain"][0]["event_data"] = base64.b64encode(made(1, 9).event_data).decode()
    record = brought(tmp_path, document(1, "1.1 2.1"), edited)
    assert sorted(names(record)) == ["1.1", "1.1 (edited)", "2.1"]
    (problem,) = record.header.problems
    assert "block 1 of its chain" in problem
    (line,) = (block.line for block in record.blocks if "edited" in block.line.name)
    assert line.claimed_hash == made(1, 1).block_hash.hex()
    assert line.block_hash != line.claimed_hash
    assert record.header.events == 6


def test_a_wrong_hash_of_a_good_block_is_told_and_its_events_are_there_once(tmp_path: Path) -> None:
    edited = document(2, "1.1 2.1")
    edited["chain"][1]["block_hash"] = "0" * 64
    record = brought(tmp_path, document(1, "1.1 2.1"), edited)
    assert record.header.events == 4
    assert "does not match its hash" in record.header.problems[0]
    assert names(record) == ["1.1", "2.1"]
    assert [block.line.claimed_hash for block in record.blocks] == [None, None]
    assert len(reconcile(record).line.chain) == 2


def test_of_two_exports_of_one_agent_the_later_counts_and_nothing_of_the_other_is_lost(tmp_path: Path) -> None:
    write(tmp_path / "before", document(1, "1.1 1.2", exported_at_us=1))
    write(tmp_path / "again", document(1, "1.1", exported_at_us=2, completed="1.1"), document(2, "1.1"))
    record = consolidate(came_home([tmp_path]))
    assert names(record) == ["1.1", "1.2"]
    assert [held.place for held in record.blocks[1].line.held] == ["earlier export"]
    assert record.header.distinct_chains == 1
    assert not record.lost
    assert "later" in record.header.remarks[0]


def test_the_same_file_twice_counts_once_and_is_no_finding(tmp_path: Path) -> None:
    write(tmp_path / "a", document(1, "1.1"))
    (tmp_path / "b.json").write_text(json.dumps(document(1, "1.1")))
    (tmp_path / "c.json").write_text(json.dumps(document(1, "1.1"), indent=3))
    done = harness("consolidate", tmp_path, tmp_path / "a")
    assert (done.returncode, done.stderr) == (0, "")
    assert "1 block and 2 events" in done.stdout


def test_another_mission_is_named_and_left_out(tmp_path: Path) -> None:
    write(tmp_path, document(1, "1.1"), document(2, "1.1"), document(7, "7.1 7.2 7.3", data=b"another"))
    record = consolidate(came_home([tmp_path]))
    assert names(record) == ["1.1"]
    (sentence,) = record.header.left_out
    assert "7.chain.json" in sentence
    assert InceptionBlock(b"another").block_hash.hex()[:12] in sentence


def test_what_is_cut_off_is_used_up_to_there(tmp_path: Path) -> None:
    write(tmp_path, document(1, "1.1"))
    text = json.dumps(document(2, "1.1 2.1 2.2 2.3", deque="2.4"), indent=1)
    where = text.index(made(2, 3).block_hash.hex())
    (tmp_path / "2.chain.json").write_text(text[:where])
    record = consolidate(came_home([tmp_path]))
    assert names(record) == ["1.1", "2.1", "2.2"]
    (problem,) = record.header.problems
    assert "2.chain.json" in problem
    assert "cut off" in problem


def test_blocks_after_a_damaged_place_are_used(tmp_path: Path) -> None:
    text = json.dumps(document(2, "2.1 2.2 2.3 2.4", deque="2.5"), indent=1)
    at = text.index(base64.b64encode(made(2, 2).event_data).decode()) + 5
    write(tmp_path, document(1, "1.1"))
    (tmp_path / "2.chain.json").write_bytes((text[:at] + '"\0{\xff' + text[at + 9 :]).encode("latin-1"))
    assert {block.line.block_hash for block in consolidate(came_home([tmp_path])).blocks} == {
        made(*which).block_hash.hex() for which in ((1, 1), (2, 1), (2, 3), (2, 4), (2, 5))
    }


def test_a_part_that_does_not_fit_is_named_and_the_others_are_used(tmp_path: Path) -> None:
    wrong = document(1, "1.1 1.2 1.3")
    wrong["chain"][1]["timestamp_us"] = "yesterday"
    wrong["idle"] = 7
    record = brought(tmp_path, wrong)
    assert [block.line.block_hash for block in record.blocks] == [made(1, n).block_hash.hex() for n in (1, 3)]
    assert any("chain.1" in problem for problem in record.header.problems)
    assert [lost.block for lost in record.lost_blocks] == ["1.2"]


def test_a_packed_export_is_read(tmp_path: Path) -> None:
    (tmp_path / "1.chain.json").write_bytes(gzip.compress(json.dumps(document(1, "1.1")).encode()))
    assert names(consolidate(came_home([tmp_path]))) == ["1.1"]


def test_other_people_s_files_are_passed_over(tmp_path: Path) -> None:
    write(tmp_path, document(1, "1.1"))
    (tmp_path / "photo.jpg").write_bytes(random.Random(1).randbytes(5000))
    (tmp_path / "notes.json").write_text("[]")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "list.txt").write_text("milk")
    record = consolidate(came_home([tmp_path]))
    assert (names(record), record.header.left_out) == (["1.1"], [])


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"\xff", b'{"schema": "ucp-chain-export/9", "agent_id": 1}', b"[" * 10**5]
)
def test_a_file_of_which_nothing_is_usable_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "3.chain.json"
    path.write_bytes(content)
    with pytest.raises(ExportError, match=r"3\.chain\.json"):
        came_home([path])
    write(tmp_path, document(1, "1.1"))
    (sentence,) = came_home([tmp_path]).left_out
    assert sentence.startswith(f"{path}: ")


def test_a_path_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FieldError):
        came_home([tmp_path / "nowhere"])


@settings(deadline=None, max_examples=300)
@given(data=st.data())
def test_no_damage_makes_a_traceback_or_an_event_that_nobody_logged(
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
    record = consolidate(came_home([directory]))
    assert [*in_words(record)]
    known = {made(*which).block_hash.hex() for which in ((1, 1), (2, 1), (2, 2), (2, 3))}
    for block in record.blocks:
        assert block.line.block_hash in known | {None} or block.line.claimed_hash or record.header.problems
    numbers = Counter((line.block, line.index) for line in written(record) if isinstance(line, Event))
    assert all(count == 1 for count in numbers.values())


# The command


def test_the_command_writes_what_it_is_asked_for_and_overwrites_nothing(tmp_path: Path) -> None:
    write(tmp_path / "home", document(1, "1.1 2.1"), document(2, "1.1", deque="2.1"))
    options = ("-o", tmp_path / "mission.jsonl", "--csv", tmp_path / "mission.csv", "--reconcile")
    done = harness("consolidate", tmp_path / "home", *options)
    assert (done.returncode, done.stderr) == (0, "")
    *_, last = read((tmp_path / "mission.jsonl").read_text())
    assert isinstance(last, Reconciled)
    assert last.uniform
    assert last.chain == [made(1, 1).block_hash.hex(), made(2, 1).block_hash.hex()]
    for agent_id in (1, 2):
        export = read_export(tmp_path / "mission.reconciled" / f"{agent_id}.chain.json")
        assert export.chain_of_block_hashes == tuple(last.chain)
    with (tmp_path / "mission.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["block"], row["index"]) for row in rows] == [("1.1", "0"), ("1.1", "1"), ("2.1", "0"), ("2.1", "1")]
    again = harness("consolidate", tmp_path / "home", *options)
    assert again.returncode == 2
    assert "exists" in sentences(again.stderr)[0]


def test_the_exit_status_says_whether_all_was_usable(tmp_path: Path) -> None:
    write(tmp_path / "home", document(1, "1.1"))
    (tmp_path / "home" / "2.chain.json").write_text("{")
    done = harness("consolidate", tmp_path / "home")
    assert done.returncode == 1
    assert len(sentences(done.stderr)) == 1
    assert harness("consolidate", tmp_path / "home" / "2.chain.json").returncode == 2
    assert harness("consolidate", tmp_path / "home", "-o", tmp_path / "x.kml").returncode == 2
    assert harness("consolidate", tmp_path / "home", "--reconcile").returncode == 2
    assert harness("consolidate", tmp_path / "home", "--kml", tmp_path / "x.kml").returncode == 2


def test_a_logged_position_is_on_the_maps(tmp_path: Path) -> None:
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
    """What the agent's own export has of its events."""
    own = [block.event_bytes for block in export.blocks() if block.agent_id == agent_id]
    return [*own, base64.b64decode(export.current_block.event_data)]

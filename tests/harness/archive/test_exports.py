"""Test the chain exports of real flights: each unusable file causes one sentence, and the other files are read."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.exports import Export, name_blocks, read_export, read_exports
from harness.errors import ExportError
from tests.harness.mission import edit, fly, write_exports
from tests.ucp.air import Air


@pytest.fixture(scope="module")
def air() -> Air:
    return fly(agents=3)


@pytest.fixture
def paths(air: Air, tmp_path: Path) -> list[Path]:
    return write_exports(air, tmp_path, traces=False)


def test_reader_restores_the_written_export(air: Air, paths: list[Path]) -> None:
    exports = read_exports(paths)
    assert not exports.errors
    assert list(exports.by_agent) == [1, 2, 3]
    for agent_id, export in exports.by_agent.items():
        agent = air.agents[agent_id]
        assert export.top_chain_hash == agent.state.chain.top_chain_hash.hex()
        assert [block.event_bytes for block in export.chain] == [block.event_data for block in agent.state.chain]


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda text: text[: len(text) // 2], "truncated or damaged"),
        (lambda text: "", "truncated or damaged"),
        (lambda text: "[]", "no `schema`"),
        (lambda text: "[" * 100_000, "truncated or damaged"),
        (lambda text: text.replace("export/1", "export/2"), "this version reads 'ucp-chain-export/1'"),
        (lambda text: text.replace('"idle": true', '"idle": "perhaps"'), "`idle` is wrong"),
        (lambda text: text.replace('"agent_id": 1', '"agent_id": 70000', 1), "`agent_id` is wrong"),
        (lambda text: text.replace('"event_data": "', '"event_data": "!', 1), "event_data` is wrong"),
        (lambda text: json.dumps({**json.loads(text), "completed": ["xyz"]}), "`completed.0` is wrong"),
    ],
)
def test_damaged_export_is_reported_and_others_are_read(paths: list[Path], damage, sentence: str) -> None:
    paths[0].write_text(damage(paths[0].read_text()))
    exports = read_exports(paths)
    assert list(exports.by_agent) == [2, 3]
    (error,) = exports.errors
    assert str(paths[0]) in error
    assert sentence in error
    assert "\n" not in error


def test_reader_ignores_unknown_fields(paths: list[Path]) -> None:
    edit(paths[0], lambda export: export.update(signature="..."))
    assert read_export(paths[0]).agent_id == 1


def test_export_of_another_mission_is_left_out(paths: list[Path], tmp_path: Path) -> None:
    other = Air([1, 2, 3, 4])
    other.agents[4].state.chain.__init__(type(other.agents[4].state.chain.inception)(b"another mission"))
    stranger = write_exports(other, tmp_path / "other", traces=False)[3]
    exports = read_exports([stranger, *paths])
    assert list(exports.by_agent) == [1, 2, 3]
    (error,) = exports.errors
    assert "agent 4 belongs to another mission" in error


def test_duplicate_export_counts_once(paths: list[Path], tmp_path: Path) -> None:
    copy = tmp_path / "copy.chain.json"
    copy.write_bytes(paths[1].read_bytes())
    exports = read_exports([*paths, copy])
    assert list(exports.by_agent) == [1, 2, 3]
    assert "counted once" in exports.errors[0]


@pytest.mark.parametrize("later_first", [False, True])
def test_later_of_two_exports_is_used_and_the_other_reported(
    paths: list[Path], tmp_path: Path, later_first: bool
) -> None:
    later = tmp_path / "later.chain.json"
    later.write_bytes(paths[1].read_bytes())
    edit(later, lambda export: export.update(exported_at_us=export["exported_at_us"] + 1))
    exports = read_exports([later, *paths] if later_first else [*paths, later])
    assert exports.by_agent[2] == read_export(later)
    (error,) = exports.errors
    assert error.startswith(str(paths[1]))


def test_unreadable_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="cannot be read"):
        read_export(tmp_path / "nowhere.chain.json")
    binary = tmp_path / "binary.chain.json"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ExportError, match="not UTF-8"):
        read_export(binary)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=10),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=10), children, max_size=3),
    max_leaves=10,
)


@given(field=st.sampled_from([field.alias or name for name, field in Export.model_fields.items()]), value=json_values)
def test_any_value_in_any_field_is_read_or_rejected(
    tmp_path_factory: pytest.TempPathFactory, field: str, value: object
) -> None:
    path = tmp_path_factory.mktemp("exports") / "1.chain.json"
    write_exports(Air([1]), path.parent, traces=False)
    edit(path, lambda export: export.update({field: value}))
    try:
        read_export(path)
    except ExportError as error:
        assert "\n" not in str(error)


def test_block_names_follow_the_order_of_agents_without_exports(paths: list[Path]) -> None:
    everything = name_blocks(read_exports(paths).by_agent)
    completed = read_export(paths[1]).completed
    assert [everything[block_hash] for block_hash in completed] == [f"2.{n}" for n in range(1, len(completed) + 1)]
    without_2 = name_blocks(read_exports([paths[0], paths[2]]).by_agent)
    assert without_2 == everything

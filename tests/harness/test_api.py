"""Test that each public package lists its public names, and imports a name only when it is first used."""

import ast
import asyncio
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from harness.api import HarnessError, MachineError, Matrix, RunArchive, Swarm, check, load_scenario, run, run_matrix

PUBLIC = ("harness.api", "ucp", "netem", "sitl")
NAMES = [(module, name) for module in PUBLIC for name in importlib.import_module(module).__all__]


@pytest.mark.parametrize(("module", "name"), NAMES, ids=[f"{module}.{name}" for module, name in NAMES])
def test_public_name_has_a_docstring_of_its_own(module: str, name: str) -> None:
    value = getattr(importlib.import_module(module), name)
    written = value.__doc__  # inspect.getdoc would return the docstring of a base class
    assert written is not None
    assert not written.startswith(f"{name}("), "a dataclass makes such a docstring itself"


@pytest.mark.parametrize("module", PUBLIC)
def test_names_for_type_checkers_are_those_imported_at_first_use(module: str) -> None:
    imported = importlib.import_module(module)
    tree = ast.parse(Path(str(imported.__file__)).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and isinstance(node.test, ast.Name)]
    for_checkers = {
        alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert for_checkers == imported._MODULE_OF
    assert sorted(imported.__all__) == sorted(for_checkers)
    assert dir(imported) == sorted(imported.__all__)


@pytest.mark.parametrize("module", PUBLIC)
def test_unknown_public_name_is_an_attribute_error(module: str) -> None:
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = importlib.import_module(module).nothing


@pytest.mark.parametrize("module", PUBLIC)
def test_importing_a_public_module_imports_none_of_its_names(module: str) -> None:
    loaded = subprocess.check_output(
        [sys.executable, "-P", "-c", f"import sys, {module}; print(*sys.modules)"], text=True
    ).split()
    own = {name for name in loaded if name.split(".")[0] in ("harness", "ucp", "netem", "sitl")}
    assert own - {"harness.compiled"} == {module, module.split(".")[0]}
    assert not {"pydantic", "yaml", "asyncio"} & {*loaded}


def test_paths_may_be_text(tmp_path: Path) -> None:
    finished = run(load_scenario("loss_15"), 1, tmp_path / "run", backend="sim")
    assert RunArchive(str(finished.directory)).roster == [1, 2, 3, 4, 5]


def test_run_without_a_directory_makes_one_under_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    finished = run(load_scenario("loss_15"), 1, backend="sim")
    assert finished.directory.parent.name == "runs"
    assert check(RunArchive(finished.directory)).judgements == finished.result.judgements


def test_run_works_inside_an_event_loop_as_in_a_notebook(tmp_path: Path) -> None:
    async def cell() -> int:
        return run(load_scenario("loss_15"), 7, tmp_path / "run", backend="sim").exit_status

    assert asyncio.run(cell()) == run(load_scenario("loss_15"), 7, tmp_path / "other", backend="sim").exit_status
    kept = [(tmp_path / name / "agents" / "1.chain.json").read_bytes() for name in ("run", "other")]
    assert kept[0] == kept[1]


def test_archive_yields_every_handler_run_and_every_held_block(tmp_path: Path) -> None:
    archive = RunArchive(run(load_scenario("loss_15"), 7, tmp_path / "run", backend="sim").directory)
    streamed = [(each.agent_id, each.life, each.line, each.run) for each in archive.handler_runs()]
    assert streamed == [
        (agent, number, line, each)
        for agent, trace in archive.traces.items()
        for number, life in enumerate(trace.incarnations(), 1)
        for line, each in life
    ]
    assert len([*archive.blocks()]) == sum(len([*export.blocks()]) for export in archive.exports.by_agent.values())
    first = next(archive.blocks())
    assert (first.holder, first.place, first.position) == (1, "chain", 0)


def test_matrix_from_a_dict_runs_into_a_new_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    keys = {"name": "small", "scenario": {"agents": 2, "duration_s": 60}, "loss": [0, 0.5], "seeds": 2}
    finished = run_matrix(Matrix.model_validate(keys))
    assert [(each.loss, each.seed) for each in finished.runs] == [(0, 1), (0, 2), (0.5, 1), (0.5, 2)]
    assert [*tmp_path.glob("runs/*small*/results.jsonl")]


def test_fixture_swarm_has_the_public_type(swarm: Swarm) -> None:
    swarm.run_for(10)
    assert isinstance(swarm, Swarm)


def test_errors_have_one_base() -> None:
    assert issubclass(MachineError, HarnessError)
    with pytest.raises(HarnessError, match="no such file or scenario"):
        load_scenario("nowhere")

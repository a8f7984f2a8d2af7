"""Test the table of backends with a new backend whose network loses nothing."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from harness.archive.directory import RunDirectory
from harness.backend_names import BACKEND_NAMES
from harness.errors import ScenarioError
from harness.play.backend import Backend
from harness.play.backends import BACKENDS, in_virtual_time
from harness.play.mission import RunOutcome, Swarm
from harness.play.progress import ProgressDisplay, SilentProgress
from harness.run.run import run
from harness.scenario import Scenario
from harness.scenario.changes import Change
from tests.harness.mission import write_exports
from tests.harness.sweep.matrix.stub import judge, matrix, played
from tests.harness.virtual import scenario
from tests.ucp.air import Air


class PerfectSwarm(Swarm):
    """A swarm on a network without loss."""

    def __init__(self, roster: list[int], seed: int, rundir: RunDirectory) -> None:
        self.played = RunOutcome(engine="perfect air")
        self.air = Air(roster)
        self._seed = seed
        self._rundir = rundir

    def now(self) -> float:
        return self.air.now

    def enter(self, stage: str) -> None:
        pass

    async def begin(self, first: Change) -> None:
        await self.apply(first)
        self.air.generate_events(self._seed)

    async def until(self, mission_s: float) -> None:
        self.air.run_until(mission_s)

    async def apply(self, change: Change) -> None:
        self.played.record(change.to_json(self.now()))

    async def stop_events(self) -> None:
        self.air.stop_events()

    async def until_idle(self, limit_s: float) -> bool:
        self.air.settle(limit_s)
        return True

    async def keep_chains(self) -> None:
        await self.snapshot()
        self._rundir.keep_exports_before_final_reconcile()

    async def reconcile(self, agent_id: int) -> None:
        self.air.reconcile(agent_id)

    async def top_chain_hashes(self) -> dict[int, str]:
        return {number: agent.state.chain.top_chain_hash.hex() for number, agent in self.air.agents.items()}

    async def completed(self) -> dict[int, int]:
        return {number: len(agent.state.completed) for number, agent in self.air.agents.items()}

    async def snapshot(self) -> RunOutcome:
        write_exports(self.air, self._rundir.agents)
        return self.played


class PerfectAir(Backend):
    """A new backend. It takes the name of an existing backend, because scenarios accept only known names."""

    name = "docker"

    def refuse(self, scenario: Scenario) -> None:
        if scenario.network.loss:
            raise ScenarioError("`network.loss` needs an air that is not perfect: leave it out")

    @asynccontextmanager
    async def open(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: ProgressDisplay,
        interrupted: asyncio.Event,
        *,
        interactive: bool = False,
        delivers_all: bool = False,
    ) -> AsyncIterator[PerfectSwarm]:
        swarm = PerfectSwarm(list(scenario.roster), seed, rundir)
        yield swarm
        swarm.played.mission_s = swarm.now()
        await swarm.snapshot()


@pytest.fixture
def perfect_air(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BACKENDS, PerfectAir.name, PerfectAir())


def test_table_maps_each_name_to_its_backend() -> None:
    assert {name: backend.name for name, backend in BACKENDS.items()} == {name: name for name in BACKEND_NAMES}


def test_name_shows_whether_a_run_was_in_virtual_time() -> None:
    assert [name for name in (*BACKEND_NAMES, "of another version", None, []) if in_virtual_time(name)] == ["sim"]


@pytest.mark.usefixtures("perfect_air")
def test_backend_in_the_table_plays_a_scenario(tmp_path: Path) -> None:
    finished = run(
        scenario(agents=3, duration_s=600, final_reconcile=True), 1, tmp_path / "run", SilentProgress(), "docker"
    )
    assert (finished.exit_status, finished.played.engine) == (0, "perfect air")
    assert {number: one.verdict for number, one in finished.result.characteristics.items()} == dict.fromkeys(
        "123456", "holds"
    )
    assert finished.result.figures["mutual_chain"] == finished.result.figures["blocks"]
    assert "perfect air" in finished.report.read_text()


@pytest.mark.usefixtures("perfect_air")
def test_refused_scenario_leaves_no_run_directory(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="needs an air that is not perfect"):
        run(scenario(network={"loss": 0.1}), 1, tmp_path / "run", SilentProgress(), "docker")
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("perfect_air")
def test_matrix_plays_the_backend_and_refuses_before_any_run(tmp_path: Path) -> None:
    asked = matrix(agents=[3], scenario={"duration_s": 60}, loss=(0.0,), seeds=2, backend="docker", keep="all")
    (cell,) = played(asked, 1, judge, tmp_path / "out").record.cells
    assert (cell.backend, cell.runs, cell.failed) == ("docker", 2, 0)
    assert len([*(tmp_path / "out" / "runs").glob("*/report.html")]) == 2
    with pytest.raises(ScenarioError, match="needs an air that is not perfect"):
        played(asked.model_copy(update={"loss": [0.0, 0.5]}), 1, judge, tmp_path / "lossy")
    assert not (tmp_path / "lossy" / "runs").exists()

"""Provide the fixture `swarm`: a swarm on any backend that a test controls step by step, in mission seconds."""

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive.archive import RunArchive
from harness.backend_names import BackendName
from harness.errors import HarnessError, ScenarioError
from harness.play import mission
from harness.play.backend import Backend
from harness.play.backends import BACKENDS
from harness.play.mission import RunOutcome, SoughtRun
from harness.play.progress import SilentProgress
from harness.pytest_plugin._live_timeline import Action, LiveTimeline
from harness.pytest_plugin.findings import Findings, JudgementInTest
from harness.run.run import Run, RunRecording
from harness.scenario import Scenario
from harness.scenario.faults import TIMELINE_FAULTS
from harness.scenario.injection import INJECTIONS

_VERBS = [*(kind.what for kind in TIMELINE_FAULTS), *INJECTIONS]


class RunEndedError(Exception):
    """An error: the run ended before the end of the test, because an agent, a vehicle or the machine failed."""


class _ActionContext(AbstractContextManager[None]):
    """A context manager that undoes an action at the end of the `with` block. If the block raises an exception, the
    action is not undone.
    """

    def __init__(self, undo: Callable[[], object]) -> None:
        self._undo = undo

    def __exit__(self, kind: type[BaseException] | None, *raised: object) -> None:
        __tracebackhide__ = True
        if kind is None:
            self._undo()


class Swarm:
    """The value of the fixture `swarm`: a swarm on any backend that the test controls.

    Times are mission seconds, and agents are named by their IDs. Virtual time does not advance between two calls. Real
    processes continue to run between two calls. Faults that become due between two calls take effect at the next call.
    All queries between two actions describe the same moment. An impossible action raises ScenarioError and changes
    nothing. Raises HarnessError if the run cannot start.
    """

    def __init__(self, scenario: Scenario, seed: int, backend: BackendName, out: Path) -> None:
        self._timeline = LiveTimeline(scenario)
        chosen = BACKENDS[backend]
        chosen.refuse(scenario)
        self._recording = RunRecording(scenario, seed, out, backend)
        self._judged = False
        self._seen: Findings | None = None
        self._interrupted = asyncio.Event()
        self._runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self._loop = self._runner.get_loop()
        self._thread = ThreadPoolExecutor(1, "ucp-swarm")
        self._playing: Future[Any] = self._thread.submit(self._play, chosen, seed)
        try:
            wait((self._timeline.started, self._playing), return_when=FIRST_COMPLETED)
            if self._playing.done():
                self._playing.result()
        except BaseException:
            self.close()
            raise

    def __repr__(self) -> str:
        return f"<swarm, run in {self.directory}>"

    def _play(self, backend: Backend, seed: int) -> RunOutcome:
        scenario, directory = self._timeline.scenario, self._recording.directory
        with self._runner:
            try:
                opening = backend.open(scenario, seed, directory, SilentProgress(), self._interrupted, interactive=True)
                return self._runner.run(mission.play_on(opening, scenario, self._timeline.play))
            except HarnessError as error:
                self._recording.fail(error)
                raise

    def partition(self, *groups: list[int], for_s: float | None = None) -> AbstractContextManager[None]:
        """Separate the groups of agents from each other. Agents that are in no group form an additional group.

        With `with swarm.partition([1, 2]):`, the partition ends at the end of the block.
        """
        __tracebackhide__ = True
        self._change(partition=[list(group) for group in groups], for_s=for_s)
        return _ActionContext(self.heal)

    def _for_a_block(self, **entry: Any) -> AbstractContextManager[None]:
        __tracebackhide__ = True
        at_s = self._change(**entry)
        return _ActionContext(partial(self._act, lambda swarm: self._timeline.undo(swarm, at_s)))

    def heal(self) -> None:
        """End the partition."""
        __tracebackhide__ = True
        self._change(heal=True)

    def loss(self, probability: float, for_s: float | None = None) -> AbstractContextManager[None]:
        """Let every receiver lose each message with this probability, from 0 to 1.

        The condition lasts for `for_s` mission seconds, until the end of a `with` block (`with swarm.loss(0.5):`), or
        for the rest of the run.
        """
        __tracebackhide__ = True
        return self._for_a_block(loss=probability, for_s=for_s)

    def network(self, for_s: float | None = None, **keys: Any) -> AbstractContextManager[None]:
        """Change network conditions. The arguments are keys of a scenario's section `network`, as in
        `network(delay=0.2, receivers={3: {"loss": 1}})`.
        """
        __tracebackhide__ = True
        return self._for_a_block(network=keys, for_s=for_s)

    def link(
        self,
        sender: int | list[int],
        receiver: int | list[int],
        *,
        both: bool = False,
        for_s: float | None = None,
        **keys: Any,
    ) -> AbstractContextManager[None]:
        """Set the network conditions from one agent to another: `link(1, 2, loss=0.9)`.

        `both` includes the opposite direction.
        """
        __tracebackhide__ = True
        if not keys:
            raise ScenarioError("a link needs a condition of its own, such as loss=0.9")
        return self.network(for_s, links=[{"from": sender, "to": receiver, "both": both, **keys}])

    def hold(self, message: str | None = None, **which: Any) -> AbstractContextManager[None]:
        """Hold back matching messages until `release` is called. This only works in virtual time.

        Messages match by `message`, `sender`, `receiver`, `block` and `count`, as in a scenario's `fates`. A criterion
        that is not given matches all messages. If the method is used as `with swarm.hold("Commit Block", sender=2):`,
        the messages are released at the end of the block. Otherwise they are released at the end of the test.
        """
        __tracebackhide__ = True
        words = _of_message(message, which)
        number = self._act(lambda swarm: self._timeline.hold(swarm, **words))
        return _ActionContext(partial(self._act, lambda swarm: self._timeline.let_go(swarm, number)))

    def release(self, message: str | None = None, **which: Any) -> None:
        """Deliver the messages that a call of `hold` with the same criteria holds back. Without criteria, deliver all
        messages that are held back.
        """
        __tracebackhide__ = True
        self._act(lambda swarm: self._timeline.release(swarm, **_of_message(message, which)))

    def __getattr__(self, verb: str) -> Callable[..., None]:
        """Return the method for a fault or an injection. The arguments of the method are the keys of a timeline entry.

        Faults: `kill(2, 4)`, `reboot(3, down_s=10)`. Injections: `replay("Commit Block", sender=2, count=3)`,
        `flood(for_s=10, per_s=50)`.
        """
        __tracebackhide__ = True
        fault = next((kind for kind in TIMELINE_FAULTS if kind.what == verb), None)
        if verb in INJECTIONS:
            return partial(self._inject, verb)
        if fault is None:
            raise AttributeError(f"a swarm has no {verb!r}; use one of {', '.join(_VERBS)}")

        def happen(*agents: int, **further: Any) -> None:
            __tracebackhide__ = True
            self._change(**fault.entry_keys(*agents, **further))

        happen.__doc__ = fault.__doc__
        return happen

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *_VERBS]

    def _inject(self, verb: str, message: str | None = None, **keys: Any) -> None:
        """Let the rogue node (a sender outside the swarm) send these datagrams from now on."""
        __tracebackhide__ = True
        self._change(**{verb: _of_message(message, keys)})

    @property
    def now_s(self) -> float:
        """The current mission second."""
        __tracebackhide__ = True
        return float(self._run_action(_now))

    def run_for(self, seconds: float) -> None:
        """Continue the mission for this number of mission seconds."""
        __tracebackhide__ = True
        if not 0 <= seconds < math.inf:
            raise ScenarioError(f"a mission cannot run for {seconds:g} s: use a time above 0")
        self._act(lambda swarm: self._timeline.until(swarm, swarm.now() + seconds))

    def run_until(self, mission_s: float) -> None:
        """Continue the mission until `mission_s`, a mission second in the future."""
        __tracebackhide__ = True
        self._act(lambda swarm: self._timeline.from_now_until(swarm, mission_s))

    def wait_for(
        self, handler: str, branch: str | None = None, agent: int | None = None, limit_s: float = 1800.0
    ) -> int:
        """Continue the mission until an agent runs this handler and, if `branch` is given, takes this branch. Return
        the agent's ID.

        A handler run that the last action caused also counts. The names are those in traces (ucp/contract/HANDLERS.md).
        Raises AssertionError if no agent runs the handler within `limit_s` mission seconds.
        """
        __tracebackhide__ = True
        if not 0 <= limit_s < math.inf:
            raise ScenarioError(f"a wait needs a limit of 0 s or more, not {limit_s:g} s")
        sought = SoughtRun(handler, branch, agent)
        found = self._act(lambda swarm: self._timeline.until_run(swarm, sought, limit_s))
        if found is None:
            who = "no agent has" if agent is None else f"agent {agent} has not"
            how = "" if branch is None else f" with the branch {branch!r}"
            raise AssertionError(f"within {limit_s:g} mission seconds {who} run {handler}{how}")
        return int(found)

    def wait_idle(self, limit_s: float = 1800.0) -> None:
        """Continue the mission until all agents are idle after the last action.

        Each running agent must also have proposed a block of its own since that action. Raises AssertionError if this
        takes longer than `limit_s` mission seconds.
        """
        __tracebackhide__ = True
        played = self._act(lambda swarm: self._timeline.until_idle(swarm, limit_s))
        if played is None:
            raise AssertionError(f"within {limit_s:g} mission seconds not every agent has voted and become idle")
        self._seen = self._judge_by_now(played)

    def final_reconcile(self) -> None:
        """End the mission: stop events, remove all network conditions, and let each agent in turn reconcile."""
        __tracebackhide__ = True
        self._act(lambda swarm: self._timeline.end(swarm, reconcile_finally=True))

    # Queries

    def characteristic(self, number: int) -> JudgementInTest:
        """Return the current verdict on a characteristic with the number 1 to 6. The result has the attributes `holds`,
        `verdict`, `reason` and `evidence`.
        """
        __tracebackhide__ = True
        return self._findings().characteristic(number)

    def judgement(self, key: str) -> JudgementInTest:
        """Return the current verdict on `steps`, `records` or `liveness`."""
        __tracebackhide__ = True
        return self._findings().judgement(key)

    @property
    def figures(self) -> dict[str, float | int | None]:
        """The current numeric results, such as `mutual_chain`, `distinct_chains` and `reconciles`."""
        __tracebackhide__ = True
        return self._findings().figures

    def chain(self, agent: int) -> list[str]:
        """Return the names of the blocks in the agent's chain, such as "4.11". The oldest block is first."""
        __tracebackhide__ = True
        return self._findings().chain(agent)

    @property
    def directory(self) -> Path:
        """The run directory."""
        return self._recording.directory.path

    @property
    def report(self) -> Path:
        """The path of the report. After the test, the report exists if the test failed, or if `--ucp-keep` is set."""
        return self.directory / "report.html"

    def _findings(self) -> Findings:
        """Return the verdicts and numeric results. The checker computes them when the test first reads them after an
        action.
        """
        __tracebackhide__ = True
        if self._seen is None:
            self._seen = self._judge_by_now(self._run_action(_snapshot))
        return self._seen

    def _judge_by_now(self, played: RunOutcome) -> Findings:
        self._recording.update_scenario(self._timeline.scenario)
        self._recording.record_outcome(played)
        return Findings(self.directory, checker.check(checker.gather(RunArchive(self.directory))))

    def _change(self, **entry: Any) -> float:
        __tracebackhide__ = True
        return float(self._act(lambda swarm: self._timeline.change(swarm, **entry)))

    def _act(self, action: Action) -> Any:
        __tracebackhide__ = True
        self._seen = None
        return self._run_action(action)

    def _run_action(self, action: Action) -> Any:
        __tracebackhide__ = True
        answer: Future[Any] = Future()
        self._in_loop(self._timeline.queue_action, action, answer)
        wait((answer, self._playing), return_when=FIRST_COMPLETED)
        if not answer.done():
            ended = self._playing.result()
            if ended.outcome == "not supported":
                pytest.skip(ended.outcome_detail or ended.outcome)
            raise RunEndedError(ended.outcome_detail or "the run has ended")
        if error := answer.exception():
            raise ScenarioError(str(error)) from None
        return answer.result()

    def _in_loop(self, callback: Callable[..., None], *arguments: Any) -> None:
        with suppress(RuntimeError):  # the loop and the run have ended
            self._loop.call_soon_threadsafe(callback, *arguments)

    def finish(self, settle: bool) -> Run:
        """End the run and judge it. If `settle` is true, first wait until the agents are idle.

        Raises MachineError.
        """
        with suppress(RunEndedError):  # the record contains the reason
            if settle:
                self._run_action(lambda swarm: self._timeline.end(swarm, reconcile_finally=False))
            else:
                self._run_action(self._timeline.break_off)
        self._in_loop(self._timeline.stop)
        return self._judge()

    def close(self) -> None:
        """End the run immediately if it is still active, and judge it."""
        self._in_loop(self._interrupted.set)
        self._in_loop(self._timeline.stop)
        self._thread.shutdown()
        if not self._judged:
            with suppress(HarnessError):  # the run could not start, or the disk is full
                self._judge()

    def _judge(self) -> Run:
        played = self._playing.result()
        self._judged = True
        self._recording.update_scenario(self._timeline.scenario)
        return self._recording.end(played)


def _of_message(message: str | None, keys: dict[str, Any]) -> dict[str, object]:
    return keys if message is None else {"message": message, **keys}


async def _snapshot(swarm: mission.Swarm) -> RunOutcome:
    return await swarm.snapshot()


async def _now(swarm: mission.Swarm) -> float:
    return swarm.now()

"""Compare the agent core with the TLA+ specification, into which a mistake may be planted."""

import abc
import functools
import re
import shutil
import subprocess
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, ClassVar, Protocol

from harness.archive.traces import Trace
from harness.archive.vocabulary import BRANCHES
from harness.proof.bounds import Bounds
from harness.proof.graph._exploration import explore
from harness.proof.model._global_states import ModelSwarm
from harness.proof.specification import RunTraces, _recorded_incarnations, _spec_states, _tlc, _validate
from harness.proof.specification._second_opinion import _config
from tests.harness.checker.reference import random_inputs
from tests.harness.checker.reference.random_inputs import LIFE, ROSTER
from tests.harness.proof.specification.mutation.directed_inputs import DATA, directed_traces, new_trace
from ucp.agent import Agent
from ucp.events import EVENT_HEADER_BYTES, MAX_EVENT_BYTES
from ucp.settings import Settings
from ucp.store import StoredState
from ucp.trace import HandlerRun

NO_GAP = {"finalize_gap_s": 0}
READINGS = {"vote_names_chain": True, "changed_before_tally": True, "phase1_tie": "pop", "phase2_tie": "block"}
"""Settings of the agent that the specification supports. All of them differ from their defaults."""
MOST_STEPS = 20
"""Maximum number of explored steps of an edited specification, divided by the number of states of the core.

The correct specification takes at most five steps for each state.
"""
NO_VALUE = "no value"
"""The result of a comparison if TLC stops, for example at the first element of an empty sequence."""
INVALID = re.compile(r"\*\*\* (?:Parse )?Error|Parsing or semantic analysis failed")
"""Matches the beginning of TLC's error message about an invalid specification."""


class Comparison(Protocol):
    """A comparison of specifications with the agent core. The tables show its name."""

    @property
    def name(self) -> str: ...

    def prepare(self) -> None:
        """Compute the results of the agent core, which are needed for every specification."""

    def differences(self, specifications: Sequence[str]) -> list[str | None]:
        """Return the first difference of each specification from the agent core, or None if there is no difference."""


@dataclass(frozen=True)
class States:
    """A comparison within bounds of the states that TLC finds with the states that `prove` finds."""

    bounds: Bounds

    @property
    def name(self) -> str:
        bounds = self.bounds
        words = [f"{bounds.agents} agents, {bounds.blocks} block{'s' * (bounds.blocks > 1)}, {bounds.network}"]
        words += [] if bounds.crossing else ["no crossing"]
        words += [] if bounds.timers_any else ["timers by duration"]
        return ", ".join([*words, *_settings_words(bounds.settings)])

    @functools.cached_property
    def real(self) -> set[_spec_states.Plain]:
        """Return the states that `prove` finds."""
        graph = explore(ModelSwarm(self.bounds), most_bytes=8e9, most_s=float("inf"))
        assert graph.ended == "complete", f"{self.name}: {graph.ended}"
        return set(_spec_states.real(graph))

    def prepare(self) -> None:
        assert self.real

    def differences(self, specifications: Sequence[str]) -> list[str | None]:
        found: dict[int, str] = {}
        while True:
            waiting = [number for number in range(1, len(specifications) + 1) if number not in found]
            states = _explored(self.bounds, {number: specifications[number - 1] for number in waiting}, len(self.real))
            if not isinstance(states, int):
                break
            found[states] = NO_VALUE
        for number in waiting:
            of_edit = states.get(number, [])
            if self.bounds.timers_any and len(of_edit) != len(self.real):
                found[number] = "fewer states" if len(of_edit) < len(self.real) else "more states"
            elif {tuple(map(_spec_states._of_record, _spec_states._value(text))) for text in of_edit} != self.real:
                found[number] = "other states"
        return [found.get(number) for number in range(1, len(specifications) + 1)]


def _explored(bounds: Bounds, specifications: Mapping[int, str], states: int) -> dict[int, list[str]] | int:
    """Let TLC explore several specifications at once, because its start takes longer than the exploration.

    Return the states that TLC finds for each specification, as text, by the number of the specification. If TLC stops,
    return the number of the specification at which it stops. TLC explores at most about `MOST_STEPS` times `states`
    steps of each specification.
    """
    swarm = (_tlc.MODULES / "Swarm.tla").read_text("utf-8")
    config = _config(bounds).partition("INVARIANTS")[0]
    names = re.findall(r"^  (\w+) =", config, re.MULTILINE)
    numbers = ", ".join(map(str, specifications))

    def each(step: str) -> str:
        return "\n".join(f"  \\/ edit = {number} /\\ S{number}!{step}" for number in specifications)

    batch = (
        f"---- MODULE Batch ----\nEXTENDS Integers, TLC\nCONSTANTS {', '.join(names)}\nVARIABLES edit, swarm\n"
        + "\n".join(f"S{number} == INSTANCE Swarm{number}" for number in specifications)
        + f"\nASSUME \\A number \\in {{{numbers}}} : TLCSet(number, 0)"
        + f"\nBegin == edit \\in {{{numbers}}} /\\ (\n{each('Init')})\nNext == edit' = edit /\\ (\n{each('Instant')})"
        + "\nSpec == Begin /\\ [][Next]_<<edit, swarm>>"
        + f"\nFew == TLCSet(edit, TLCGet(edit) + 1) /\\ TLCGet(edit) <= {MOST_STEPS * states + 100}\n====\n"
    )
    with tempfile.TemporaryDirectory(prefix="ucp-edited-spec-") as name:
        folder = Path(name)
        (folder / "Batch.tla").write_text(batch)
        (folder / "Batch.cfg").write_text(config + "CONSTRAINT Few\n")
        for number, text in specifications.items():
            (folder / f"UCP{number}.tla").write_text(text.replace("MODULE UCP ", f"MODULE UCP{number} "))
            own = swarm.replace("MODULE Swarm ", f"MODULE Swarm{number} ").replace(
                "INSTANCE UCP ", f"INSTANCE UCP{number} "
            )
            (folder / f"Swarm{number}.tla").write_text(own)
        call = [*_tlc.command(), "-dump", "dot", "all", "Batch"]
        done = subprocess.run(call, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
        if "states left on queue" not in done.stdout or "\nError:" in done.stdout:
            stopped = re.findall(r"\bedit = (\d+)|in (?:Swarm|UCP)(\d+)", done.stdout)
            if not stopped or INVALID.search(done.stdout):
                raise ValueError(f"an edited text is no specification: {done.stdout[-2000:]}")
            return int("".join(stopped[-1]))
        found: dict[int, list[str]] = defaultdict(list)
        with (folder / "all.dot").open() as lines:
            for line in lines:
                if node := _spec_states._NODE.match(line):
                    text = node[1].replace("\\n", " ").replace('\\"', '"').replace("\\\\", "\\")
                    number = re.search(r"edit = (\d+)", text)
                    assert number is not None, text
                    found[int(number[1])].append(re.split(r"swarm = ", text)[1].split("/\\ edit")[0])
        return found


@dataclass(frozen=True)
class Inputs(abc.ABC):
    """A comparison of an agent's steps for some inputs with the steps that the specification allows."""

    settings: tuple[tuple[str, Any], ...] = ()

    @property
    @abc.abstractmethod
    def inputs(self) -> str:
        """The name of the inputs in tables, which is a noun phrase."""

    @abc.abstractmethod
    def traces(self) -> list[Trace]:
        """Return traces of the agent core for these inputs. All traces have the same settings."""

    @property
    def name(self) -> str:
        return ", ".join([self.inputs, *_settings_words(dict(self.settings))])

    @functools.cached_property
    def encoded(self) -> tuple[_validate.Constants, _validate._EncodedStepBatch]:
        """The steps of the agent core in the form that TLC reads, with the settings of the specification."""
        with _all_tallies():
            [batch] = _validate._batches([RunTraces(self.name, self.traces())], _validate.TraceValidation())
        assert not any(life.unread for life in batch[1].lives)
        return batch

    def prepare(self) -> None:
        assert self.encoded

    def differences(self, specifications: Sequence[str]) -> list[str | None]:
        return [self._difference(specification) for specification in specifications]

    def _difference(self, specification: str) -> str | None:
        try:
            with _modules_with(specification):
                return "other steps" if _validate._rejected(*self.encoded) else None
        except _tlc.CheckerError as error:
            if INVALID.search(str(error)):
                raise ValueError(f"the edited text is no specification: {error}") from None
            return NO_VALUE


class DirectedInputs(Inputs):
    """A comparison for the sequences of inputs that the module `directed_inputs` defines."""

    @property
    def inputs(self) -> str:
        return "directed inputs"

    def traces(self) -> list[Trace]:
        return directed_traces(dict(self.settings))


class RandomInputs(Inputs):
    """A comparison for random inputs."""

    COUNT: ClassVar = 2_500

    @property
    def inputs(self) -> str:
        return f"{self.COUNT:,} random inputs"

    def traces(self) -> list[Trace]:
        return [random_trace(0, self.COUNT, dict(self.settings))]


@contextmanager
def _all_tallies() -> Iterator[None]:
    """Compare the tally after each handler run inside the context.

    An ordinary comparison skips a tally that counts nothing at the moment, because agents need not keep it.
    """
    before = _recorded_incarnations.COUNTING
    _recorded_incarnations.COUNTING = frozenset(branch for branches in BRANCHES.values() for branch in branches)
    try:
        yield
    finally:
        _recorded_incarnations.COUNTING = before


def _settings_words(settings: Mapping[str, Any]) -> list[str]:
    words = ["no gap"] if settings.get("finalize_gap_s") == 0 else []
    return words + (["other readings"] if READINGS.items() <= settings.items() else [])


@contextmanager
def _modules_with(specification: str) -> Iterator[None]:
    """Let TLC read this specification in place of the specification in the repository."""
    before = _tlc.MODULES
    with tempfile.TemporaryDirectory(prefix="ucp-edited-spec-") as name:
        for path in before.glob("*.tla"):
            shutil.copy(path, name)
        (Path(name) / "UCP.tla").write_text(specification, "utf-8")
        _tlc.MODULES = Path(name)
        try:
            yield
        finally:
            _tlc.MODULES = before


def random_trace(seed: int, count: int, settings: dict[str, Any]) -> Trace:
    """Return the trace of an agent that gets `count` random inputs and restarts after every LIFE inputs."""
    rng, now = Random(seed), 0.0
    inputs = random_inputs.Inputs(rng, newest_us=4)
    used = Settings(**{"max_block_bytes": MAX_EVENT_BYTES + 2 * EVENT_HEADER_BYTES + 40, **settings})
    trace = new_trace(used)
    stored: StoredState | None = None
    for number in range(count):
        if number % LIFE == 0:
            agent = Agent(1, ROSTER, DATA, used)
            if stored is not None:
                trace.starts.append(len(trace.runs))
                agent.boot(stored, now)
        now, give = inputs.draw(agent, number, now)
        give(agent)
        trace.runs += [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]
        agent.messages_to_send()
        stored = StoredState.of(agent.state)
        now += rng.choice((0.0, 0.01, 0.4))
    return trace

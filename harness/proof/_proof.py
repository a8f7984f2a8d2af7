"""Prove properties within bounds: explore all states, examine their graph, and write each violation as a scenario."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.archive.directory import default_path
from harness.errors import INCOMPLETE, INTERRUPTED, VIOLATED, HarnessError
from harness.proof._progress_bar import (
    Ended,
    ExplorationBudget,
    ExplorationFigures,
    ExplorationProgress,
    LimitReachedError,
)
from harness.proof.bounds import Bounds, BoundsError
from harness.proof.examples._example import ViolationExample, keep, play
from harness.proof.examples._path_script import NO_CLOCKS, PathScript
from harness.proof.graph._exploration import StateGraph, explore
from harness.proof.graph._workers import Workers
from harness.proof.model._any_sender import collect
from harness.proof.model._flaws import PropertyViolation
from harness.proof.model._global_states import AGENTS, ZONE, ModelSwarm
from harness.proof.model._snapshot import ReductionError, UncoveredError
from harness.proof.questions import _convergence as liveness
from harness.proof.questions import _livelock
from harness.proof.questions._convergence import ConvergenceResult
from harness.proof.questions._graph_cycles import cycles
from harness.proof.questions._livelock import Livelock
from harness.run.simulate import choose_path

"""Exit status: the proof reached a limit before it had explored all states."""
CLAIMS = {
    "2": "an idle agent has committed every block that it completed",
    "3": "no agent holds a block twice",
    "4": "every block is genuine",
    "hang": "no agent reconciles without a timer that ends the reconcile",
    "crash": "no handler ends by an error",
    "steps": "every step is that of the reference",
}
"""Properties that the proof checks in every state. The value of each key is a sentence. The property "steps" is checked
only on request.
"""
OF_CAPTORS = {
    "1": "every accepted message was sent by the vehicle that it names",
    "4": "every block is genuine",
}
"""Properties that an attacker with captured keys can violate although all agents are correct."""
SHOWN = {
    "1": "an agent accepts a message that the captured vehicle never sent",
    "4": "an agent holds a block under the ID of the captured vehicle that this vehicle never completed",
}
OF_OTHERS = {
    "honest": "every block of the other vehicles is genuine",
    "name": "no forged message is accepted, and no block without the signature of its maker",
    "revoked": "an agent that knows the revocation accepts no message of the captured vehicle",
}
"""Properties that an attacker with captured keys must not be able to violate."""
RUN_LOOKED_FOR_S = 60.0
"""Maximum number of seconds to search for a run of the whole swarm that shows the violation of a single agent."""
CYCLES_LOOKED_FOR_S = 60.0
"""Maximum number of seconds to search for livelocks in an incomplete graph."""
PLAYED = {
    "honest": "4",
    "name": "1",
    "revoked": "1",
    "2": "2",
    "3": "3",
    "4": "4",
    "hang": "liveness",
    "crash": "steps",
    "steps": "steps",
}
"""Kind of violation -> the check of the checker that detects this violation in a simulated run."""


@dataclass(frozen=True)
class Limits:
    """The limits of a proof: `most_bytes` is the memory of all processes together in bytes, `most_s` is the time in
    seconds, and `cores` is the number of worker processes.
    """

    most_bytes: float = 4e9
    most_s: float = float("inf")
    cores: int = 1

    def __post_init__(self) -> None:
        if self.cores < 1:
            raise BoundsError(f"--cores must be 1 or more, not {self.cores}")

    @property
    def of_exploring(self) -> dict[str, Any]:
        return {"most_bytes": self.most_bytes, "most_s": self.most_s}


@dataclass
class Proof:
    """The result of a proof within bounds.

    `complete` is true if all states within the bounds were explored. `exit_status` is 0 if every property holds, 1 if a
    property does not hold, 4 if the proof reached a limit first, and 130 if the user interrupted the proof.
    """

    bounds: Bounds
    figures: ExplorationFigures
    ended: Ended
    flaw: PropertyViolation | None
    """The first violation of a property that the prover found. None if it found none."""
    liveness: ConvergenceResult | None = None
    """The answers to the questions about the whole graph, for example about livelocks. None if the questions were not
    examined, because some states are unknown or messages may be arbitrarily late (network `any`).
    """
    whole_ended: Ended = "complete"
    """How the examination of the whole graph ended: completely, or at a limit."""
    example: ViolationExample | None = None
    """A scenario that shows a violation. None without a violation. With the network `any`, also None if the prover
    knows no run of the whole swarm with the violation.
    """
    fork: ViolationExample | None = None
    """A scenario that leads to the nearest state in which all agents are idle and their chains differ. This state
    violates no property, and it does not change until an agent starts a vote. None if no such state is known.
    """
    reluctant: ViolationExample | None = None
    """A scenario that leads to the nearest state that needs more than one further vote until all chains are equal. None
    if no such state is known.
    """
    forms: list[str] = field(default_factory=list)
    """The forms of all livelocks (endless cycles). A form lists the timers that run in the states of the livelock."""
    livelocks: list[Livelock] = field(default_factory=list)
    """One livelock of each form, with the scenario that shows it. The exploration that found the livelocks may be
    incomplete.
    """
    way: list[str] = field(default_factory=list)
    """The steps of a single agent that lead to the violation. Only with the network `any`."""
    shown: dict[str, ViolationExample | None] = field(default_factory=dict)
    """Characteristic that an attacker can violate (see `OF_CAPTORS`) -> a scenario that shows the nearest such
    violation. With the network `any`, the value is None.
    """

    @property
    def claims(self) -> dict[str, str]:
        """The properties that the proof checks in every state. The value of each key is a sentence that states the
        property.
        """
        claims = CLAIMS if self.bounds.steps else {kind: claim for kind, claim in CLAIMS.items() if kind != "steps"}
        if self.bounds.captured is None:
            return claims
        return {**dict(sorted({**claims, **OF_CAPTORS}.items())), **OF_OTHERS}

    @property
    def complete(self) -> bool:
        return self.ended == "complete"

    @property
    def decided(self) -> bool:
        """True if every property was decided. It is false if a limit, the user or a violation ended the search early,
        or if a question was left open.
        """
        whole = self.whole_ended == "complete" and (self.liveness is None or self.liveness.decided)
        return self.complete and whole and not self.left_open

    @property
    def left_open(self) -> bool:
        """True if the proof cannot decide whether every state has a path to one chain.

        This happens only with the option `zones_contained`, with which a state also represents states with fewer
        possible timer values. If no path to one chain is found for such a state, the reason may be one of the
        represented states and not the state itself.
        """
        return self.bounds.zones_contained and self.liveness is not None and self.liveness.lost is not None

    @property
    def findings(self) -> dict[str, str]:
        """The violations by key, each as a sentence. The same violation has the same key in proofs of different agent
        cores.

        The key of a crash contains its exception, the key of a wrong step contains the handler, and the key of a
        livelock contains its form.
        """
        found = {f"shown {key}": sentence for key, sentence in SHOWN.items() if key in self.shown}
        if self.flaw is not None:
            detail = {"crash": self.flaw.sentence, "steps": self.flaw.handler}.get(self.flaw.kind)
            key = self.flaw.kind if detail is None else f"{self.flaw.kind} {detail}"
            found[key] = f"{self.claims[self.flaw.kind]}: violated, {self.flaw.sentence}"
        for form in self.forms:
            found[f"livelock {form}"] = f"a cycle without losses lasts for ever, with the timers {form}"
        if self.liveness is not None and self.liveness.lost is not None and not self.left_open:
            found["one chain"] = "from some state no path without losses leads to an idle swarm with one chain"
        return found

    @property
    def exit_status(self) -> int:
        if self.findings:
            return VIOLATED
        if "interrupted" in (self.ended, self.whole_ended):
            return INTERRUPTED
        return 0 if self.decided else INCOMPLETE

    def to_json(self) -> dict[str, Any]:
        bounds, live, flaw = self.bounds, self.liveness, self.flaw
        return {
            "schema": "ucp-proof/1",
            "agents": bounds.agents,
            "blocks": bounds.blocks,
            "network": bounds.network,
            "faults": list(bounds.faults),
            "timers": "any" if bounds.timers_any else "duration",
            "coincidences": bounds.coincidences,
            "clocks": "any" if bounds.clocks_any else "agreed",
            "zones_contained": bounds.zones_contained,
            "losses": bounds.losses,
            "crossing": bounds.crossing,
            "settings": dict(bounds.settings),
            "stagger": dict(bounds.stagger),
            **(self._attacker_json() if bounds.captured is not None else {}),
            "quirks": dict(bounds.quirks),
            "reduced": bounds.reduced,
            "steps_judged": bounds.steps,
            "complete": self.complete,
            "ended": self.ended,
            "whole_ended": self.whole_ended,
            **asdict(self.figures),
            "flaw": None if flaw is None else asdict(flaw),
            "way": self.way,
            "forks_at_rest": None if live is None else live.forks,
            "fork": None if self.fork is None else self.fork.to_json(),
            "reluctant": None if self.reluctant is None else self.reluctant.to_json(),
            "without_a_way_to_one_chain": None if live is None else live.astray,
            "livelocks": sum(each.ways for each in self.livelocks) or None if live is None else len(live.cycles),
            "livelock_forms": [each.to_json() for each in self.livelocks],
            "example": None if self.example is None else self.example.to_json(),
        }

    def _attacker_json(self) -> dict[str, Any]:
        return {
            "captured": self.bounds.captured,
            "lies": None if self.bounds.network == "any" else self.bounds.lies,
            "shown": {key: None if example is None else example.to_json() for key, example in self.shown.items()},
        }


def prove(
    bounds: Bounds,
    limits: Limits = Limits(),
    out: Path | None = None,
    *,
    watch: Callable[[ExplorationProgress], None] = lambda progress: None,
) -> Proof:
    """Explore every state that agents can reach within `bounds`, check each state, and return the result.

    - `limits`: memory, time and worker processes of the proof. The proof stops when a limit is reached.
    - `out`: the path of the new scenario file that shows a violation. By default, a new file under `runs/`.
    - `watch`: a function that is called repeatedly with the progress.

    Raises HarnessError if the file cannot be written. Also raises it if an agent violates an assumption of the state
    reduction, or if its steps depend on data that are not part of a state.
    """
    if bounds.reduced and bounds.why_not_reduced() is not None:
        bounds = replace(bounds, reduced=False)
    try:
        if bounds.network == "any":
            return _prove_single_agents(bounds, limits, out, watch)
        return _prove_swarm(bounds, limits, out, watch)
    except (ReductionError, UncoveredError) as error:
        raise HarnessError(f"{error}") from None


def _prove_single_agents(
    bounds: Bounds, limits: Limits, out: Path | None, watch: Callable[[ExplorationProgress], None]
) -> Proof:
    name, path = _name_and_path(bounds, out)
    began_s = time.process_time()
    found = collect(bounds, most_bytes=limits.most_bytes, most_s=limits.most_s, watch=watch)
    figures = ExplorationFigures(
        found.states,
        found.looked_at,
        found.transitions,
        found.local_states,
        found.steps,
        found.zones,
        None,
        round(found.seconds, 3),
        round(time.process_time() - began_s, 3),
    )
    proof = Proof(bounds, figures, found.ended, found.flaw, way=found.way, shown=dict.fromkeys(sorted(found.shown)))
    if found.flaw is not None:
        limits = replace(limits, most_s=min(RUN_LOOKED_FOR_S, limits.most_s - found.seconds))
        swarm = ModelSwarm(_with_instants(bounds))
        with Workers(swarm, limits.cores) as workers:
            graph = explore(swarm, **limits.of_exploring, workers=workers, watch=watch)
        if graph.flawed is not None and graph.flaw is not None and graph.flaw.kind == found.flaw.kind:
            proof.example = _example(graph, graph.flawed, graph.flaw.sentence, path, name)
    return proof


def _with_instants(bounds: Bounds) -> Bounds:
    """Return the same bounds, except that the network `any` becomes a network that loses and duplicates messages. In
    the new network, messages are never arbitrarily late. Each path through the states is then a possible run. With the
    network `any`, this is not certain.
    """
    return replace(bounds, network="lossy", faults=tuple(dict.fromkeys((*bounds.faults, "duplicate"))))


def _name_and_path(bounds: Bounds, out: Path | None) -> tuple[str, Path]:
    """Return the name and the file path of the scenario that the proof writes."""
    name = f"proof {bounds.agents} agents {bounds.blocks} blocks"
    return name, choose_path(out or default_path(name).with_suffix(".yaml"), name)


def _prove_swarm(
    bounds: Bounds, limits: Limits, out: Path | None, watch: Callable[[ExplorationProgress], None]
) -> Proof:
    name, path = _name_and_path(bounds, out)
    began_s = time.process_time()
    swarm = ModelSwarm(bounds)
    with Workers(swarm, limits.cores) as workers:
        graph = explore(swarm, **limits.of_exploring, workers=workers, watch=watch)
        figures = ExplorationFigures(
            len(graph.states),
            graph.looked_at,
            graph.transitions,
            len({local for state in graph.states for local in state[AGENTS:]}),
            swarm.local.steps + graph.workers_steps,
            len({state[ZONE] for state in graph.states}),
            graph.depth,
            round(graph.seconds, 3),
            round(time.process_time() - began_s + graph.workers_s, 3),
        )
        proof = Proof(bounds, figures, graph.ended, graph.flaw)
        if proof.complete:
            budget = ExplorationBudget(limits.most_bytes, limits.most_s - graph.seconds)

            def asked_now(asked: str) -> None:
                if budget.check(workers.memory_bytes):
                    watch(graph.progress(graph.seconds + budget.seconds, asked))

            try:
                proof.liveness = liveness.look(graph, asked_now, workers)
            except LimitReachedError as given_up:
                proof.whole_ended = given_up.ended
            except KeyboardInterrupt:
                proof.whole_ended = "interrupted"
    _show(proof, graph, path, name)
    return proof


def _show(proof: Proof, graph: StateGraph, path: Path, name: str) -> None:
    """Write a scenario for each violation, the first one to `path`."""
    live = proof.liveness
    ways_round = live.cycles if live is not None else _known_cycles(graph) if proof.ended in ("memory", "time") else []
    for key, number in graph.shown.items():
        beside = path.with_stem(f"{path.stem}_characteristic_{key}")
        proof.shown[key] = _example(graph, number, SHOWN[key], beside, f"{name} characteristic {key}")
    if proof.flaw is not None and graph.flawed is not None:
        proof.example = _example(graph, graph.flawed, proof.flaw.sentence, path, name)
    elif ways_round:
        proof.forms = _livelock.in_timers(graph, ways_round)
        proof.livelocks = list(_livelock.show(graph, ways_round, path, name))
        proof.example = proof.livelocks[0].example
    elif live is not None and live.lost is not None and not proof.left_open:
        proof.example = _example(
            graph, live.lost, "no path from here to an idle swarm with one chain was found", path, name
        )
    if live is not None and live.fork is not None:
        beside = path.with_stem(f"{path.stem}_fork")
        sentence = "all agents are idle and their chains differ: they stay so until an agent starts a vote"
        proof.fork = _example(graph, live.fork, sentence, beside, f"{name} fork")
    if live is not None and live.reluctant is not None and live.lost is None and live.decided:
        beside = path.with_stem(f"{path.stem}_votes")
        sentence = "one more vote does not lead from here to one chain"
        proof.reluctant = _example(graph, live.reluctant, sentence, beside, f"{name} votes")


def _known_cycles(graph: StateGraph) -> list[list[int]]:
    """Return the cycles that the search finds in an incomplete graph. If states of the graph represent several states,
    each cycle must be confirmed with exact states. The search for confirmed cycles ends after `CYCLES_LOOKED_FOR_S`
    seconds.
    """
    if graph.states.exact:
        return [*cycles(graph)]
    found: list[list[int]] = []
    with suppress(LimitReachedError):
        found.extend(cycles(graph, ExplorationBudget(float("inf"), CYCLES_LOOKED_FOR_S).check))
    return found


def _example(graph: StateGraph, number: int, sentence: str, path: Path, name: str) -> ViolationExample:
    states = graph.path(number)
    script = PathScript(graph, states)
    played = play(script.document(name))
    said = [f"{sentence[:1].upper()}{sentence[1:]}: {len(states) - 1} instants after the beginning."]
    said += [f"This path needs a condition: it happens only {NO_CLOCKS}."] if script.contradictory else []
    return keep(played, path, graph.swarm.bounds, len(states) - 1, said)

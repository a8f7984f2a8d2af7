"""From bounds to what holds within them: explore, look at the whole, and write what was found as scenarios."""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from harness.archive.directory import default_path
from harness.checker.judgement import Judgement
from harness.errors import INTERRUPTED, VIOLATED, HarnessError
from harness.prove import liveness
from harness.prove.alone import collect
from harness.prove.bounds import Bounds
from harness.prove.explore import Graph, explore
from harness.prove.liveness import Liveness
from harness.prove.local import Flaw, ReductionError
from harness.prove.progress import Ended, Figures, Progress
from harness.prove.script import Script
from harness.prove.swarm import Swarm
from harness.run.finding import claim, evidence_lines, simulated, write
from harness.scenario.load import parse
from harness.scenario.write import to_yaml

INCOMPLETE = 4
"""Exit status: a bound was reached before everything had been looked at."""
SEED = 1
MOST_PLAYED = 20
"""So many ways to the same thing are played, to find one that the simulation goes too."""
CLAIMS = {
    "2": "an idle agent has committed every block that it completed",
    "3": "no agent holds a block twice",
    "4": "every block is genuine",
    "hang": "no agent reconciles without a timer that would end it",
    "crash": "no handler ends by an error",
}
"""What is looked at in every state."""


@dataclass(frozen=True)
class Limits:
    """When to give up: memory of this process, and time."""

    most_bytes: float = 4e9
    most_s: float = float("inf")


@dataclass(frozen=True)
class Example:
    """A way to something that was found, as a scenario in `path`; `judged` is what is bad about its simulated run."""

    path: Path
    instants: int
    judged: dict[str, Judgement]

    @property
    def replay(self) -> str:
        return f"ucp-harness run {self.path} --backend sim --seed {SEED}"

    def to_json(self) -> dict[str, Any]:
        judged = {key: judgement.verdict for key, judgement in self.judged.items()}
        return {"path": str(self.path), "instants": self.instants, "replay": self.replay, "judged": judged}


@dataclass
class Proof:
    """What came out. `liveness` is None if it was not looked at: not all states are known, or the network is `any`.

    `way` is what an agent did that has a flaw in the network `any`, where nothing shows that all of it fits together.
    """

    bounds: Bounds
    figures: Figures
    ended: Ended
    flaw: Flaw | None
    liveness: Liveness | None = None
    example: Example | None = None
    way: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        return self.ended == "complete"

    @property
    def exit_status(self) -> int:
        live = self.liveness
        if self.flaw or (live is not None and (live.cycles or live.lost is not None)):
            return VIOLATED
        if self.ended == "interrupted":
            return INTERRUPTED
        return 0 if self.complete and (live is None or live.decided) else INCOMPLETE

    def to_json(self) -> dict[str, Any]:
        bounds, live, flaw = self.bounds, self.liveness, self.flaw
        return {
            "schema": "ucp-proof/1",
            "agents": bounds.agents,
            "blocks": bounds.blocks,
            "network": bounds.network,
            "faults": list(bounds.faults),
            "timers": "any" if bounds.timers_any else "duration",
            "settings": dict(bounds.settings),
            "quirks": dict(bounds.quirks),
            "reduced": bounds.reduced,
            "complete": self.complete,
            "ended": self.ended,
            **asdict(self.figures),
            "flaw": None if flaw is None else asdict(flaw),
            "way": self.way,
            "forks_at_rest": None if live is None else live.forks,
            "without_a_way_to_one_chain": None if live is None else live.astray,
            "livelocks": None if live is None else len(live.cycles),
            "example": None if self.example is None else self.example.to_json(),
        }


def prove(
    bounds: Bounds,
    limits: Limits = Limits(),
    out: Path | None = None,
    *,
    watch: Callable[[Progress], None] = lambda progress: None,
) -> Proof:
    """Look at everything within `bounds`; what is found is written to `out`, or to a new file under `runs`.

    Raises HarnessError if nothing can be written, or if the agent does what a reduction must not meet.
    """
    try:
        if bounds.network == "any":
            return _alone(bounds, limits, watch)
        return _together(bounds, limits, out, watch)
    except ReductionError as error:
        raise HarnessError(f"{error}") from None


def _alone(bounds: Bounds, limits: Limits, watch: Callable[[Progress], None]) -> Proof:
    began_s = time.process_time()
    found = collect(bounds, most_bytes=limits.most_bytes, most_s=limits.most_s, watch=watch)
    figures = Figures(
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
    return Proof(bounds, figures, found.ended, found.flaw, way=found.way)


def _together(bounds: Bounds, limits: Limits, out: Path | None, watch: Callable[[Progress], None]) -> Proof:
    name = f"proof {bounds.agents} agents {bounds.blocks} blocks"
    path = claim(out or default_path(name).with_suffix(".yaml"), name)
    began_s = time.process_time()
    swarm = Swarm(bounds)
    graph = explore(swarm, most_bytes=limits.most_bytes, most_s=limits.most_s, watch=watch)
    figures = Figures(
        graph.reached,
        graph.looked_at,
        graph.transitions,
        len(swarm.local.known),
        swarm.local.steps,
        len(swarm.zones),
        graph.depth,
        round(graph.seconds, 3),
        round(time.process_time() - began_s, 3),
    )
    proof = Proof(bounds, figures, graph.ended, graph.flaw)
    if proof.complete:
        proof.liveness = liveness.look(graph)
    proof.example = _example(graph, proof.liveness, path, name)
    return proof


def _ways(graph: Graph, live: Liveness | None) -> Iterator[tuple[list[int], str, str]]:
    """Ways to what was found, the shortest first, each with a sentence and the key of what is bad when it is played."""
    if graph.flawed is not None and graph.flaw is not None:
        kind = graph.flaw.kind
        yield graph.path(graph.flawed), graph.flaw.sentence, kind if kind.isdecimal() else "liveness"
    elif live is not None and live.cycles:
        ways = [[*graph.path(cycle[0]), *cycle[1:], cycle[0]] for cycle in live.cycles]
        for way in sorted(ways, key=len):
            yield way, "the swarm can go round in circles for ever", "liveness"
    elif live is not None and live.lost is not None:
        yield graph.path(live.lost), "no way was found from here to rest with one chain", "6"


def _example(graph: Graph, live: Liveness | None, path: Path, name: str) -> Example | None:
    """The first that the simulation plays as it is meant, or the first of all; written to `path`."""
    first = None
    for way, sentence, key in islice(_ways(graph, live), MOST_PLAYED):
        document = Script(graph, way).document(name)
        result = simulated(parse(document), SEED)
        played = document, len(way) - 1, sentence, {bad: result.judgements[bad] for bad in result.bad}
        first = first or played
        if key in result.bad:
            break
    else:
        if first is None:
            return None
        played = first
    document, instants, sentence, judged = played
    comment = [
        f"{sentence.capitalize()}: {instants} instants after the beginning.",
        f"A shortest way within {graph.swarm.bounds.in_words()}.",
        *evidence_lines(judged),
        f"  ucp-harness run {path} --backend sim --seed {SEED}",
    ]
    return Example(write(path, to_yaml(document, comment)), instants, judged)

"""From bounds to what holds within them: explore, look at the whole, and write what was found as scenarios."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from harness.archive.directory import default_path
from harness.checker.judgement import Judgement
from harness.errors import INTERRUPTED, VIOLATED, HarnessError
from harness.explore.search import simulated
from harness.explore.write import claim, evidence_lines, write
from harness.prove import liveness
from harness.prove.bounds import Bounds
from harness.prove.explore import Graph, Progress, explore
from harness.prove.liveness import Liveness
from harness.prove.local import ReductionError
from harness.prove.script import Script
from harness.prove.swarm import Swarm
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
    """What came out. `liveness` is None if not all states are known, or one of them has a flaw."""

    graph: Graph
    liveness: Liveness | None = None
    example: Example | None = None

    @property
    def bounds(self) -> Bounds:
        return self.graph.swarm.bounds

    @property
    def complete(self) -> bool:
        return self.graph.ended == "complete"

    @property
    def exit_status(self) -> int:
        live = self.liveness
        if self.graph.flaw or (live is not None and (live.cycles or live.lost is not None)):
            return VIOLATED
        if self.graph.ended == "interrupted":
            return INTERRUPTED
        return 0 if self.complete else INCOMPLETE

    def to_json(self) -> dict[str, Any]:
        graph, bounds, live = self.graph, self.bounds, self.liveness
        flaw = graph.flaw
        return {
            "schema": "ucp-proof/1",
            "agents": bounds.agents,
            "blocks": bounds.blocks,
            "network": bounds.network,
            "faults": list(bounds.faults),
            "timers": "any" if bounds.timers_any else "by duration",
            "settings": dict(bounds.settings),
            "quirks": dict(bounds.quirks),
            "reduced": bounds.reduced,
            "complete": self.complete,
            "ended": graph.ended,
            "states": graph.reached,
            "looked_at": graph.looked_at,
            "transitions": graph.transitions,
            "local_states": len(graph.swarm.local.known),
            "steps_of_the_agent": graph.swarm.local.steps,
            "zones": len(graph.swarm.zones),
            "depth": graph.depth,
            "seconds": round(graph.seconds, 3),
            "flaw": None if flaw is None else {"kind": flaw.kind, "sentence": flaw.sentence},
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
    name = f"proof {bounds.agents} agents {bounds.blocks} blocks"
    path = claim(out or default_path(name).with_suffix(".yaml"), name)
    try:
        graph = explore(Swarm(bounds), most_bytes=limits.most_bytes, most_s=limits.most_s, watch=watch)
        proof = Proof(graph)
        if proof.complete:
            proof.liveness = liveness.look(graph)
    except ReductionError as error:
        raise HarnessError(f"{error}") from None
    proof.example = _example(proof, path, name)
    return proof


def _ways(proof: Proof) -> Iterator[tuple[list[int], str, str]]:
    """Ways to what was found, the shortest first, each with a sentence and the key of what is bad when it is played."""
    graph, live = proof.graph, proof.liveness
    if graph.flawed is not None and graph.flaw is not None:
        kind = graph.flaw.kind
        yield graph.path(graph.flawed), graph.flaw.sentence, kind if kind.isdecimal() else "liveness"
    elif live is not None and live.cycles:
        ways = [[*graph.path(cycle[0]), *cycle[1:], cycle[0]] for cycle in live.cycles]
        for way in sorted(ways, key=len):
            yield way, "the swarm can go round in circles for ever", "liveness"
    elif live is not None and live.lost is not None:
        yield graph.path(live.lost), "no way was found from here to rest with one chain", "6"


def _example(proof: Proof, path: Path, name: str) -> Example | None:
    """The first that the simulation plays as it is meant, or the first of all; written to `path`."""
    first = None
    for way, sentence, key in islice(_ways(proof), MOST_PLAYED):
        document = Script(proof.graph, way).document(name)
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
        f"A shortest way within {proof.bounds.in_words()}.",
        *evidence_lines(judged),
        f"  ucp-harness run {path} --backend sim --seed {SEED}",
    ]
    return Example(write(path, to_yaml(document, comment)), instants, judged)

"""Play a path through the state graph in the simulation, and write it as a scenario."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.archive.run_record import Cycle
from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.checker.recurring_cycles import cycle_of
from harness.play.variant import variant_in_use
from harness.proof.bounds import Bounds
from harness.run.simulate import evidence_lines, simulate, write_new_file
from harness.scenario.load import parse
from harness.scenario.scenario_file import to_yaml

SEED = 1

Document = dict[str, Any]


@dataclass(frozen=True)
class ViolationExample:
    """A scenario file that plays a path to a violation. `judged` contains the bad verdicts on the simulated run."""

    path: Path
    instants: int
    judged: dict[str, Judgement]
    chains: int
    """Number of different chains at the end of the run."""

    @property
    def replay(self) -> str:
        variant = variant_in_use()
        option = "" if variant is None else f" --variant {variant.file}"
        return f"ucp-harness run {self.path} --backend sim --seed {SEED}{option}"

    def to_json(self) -> dict[str, object]:
        judged = {key: judgement.verdict for key, judgement in self.judged.items()}
        return {
            "path": str(self.path),
            "instants": self.instants,
            "replay": self.replay,
            "judged": judged,
            "chains": self.chains,
        }


@dataclass(frozen=True)
class PlayedExample:
    """A simulated run: its bad verdicts, and the endless cycle of its agents. The cycle is None if the run has no such
    cycle.
    """

    document: Document
    judged: dict[str, Judgement]
    cycle: Cycle | None
    chains: int


def play(document: Document) -> PlayedExample:
    simulated = simulate(parse(document), SEED, tracing=True)
    result, cycle = simulated.result, simulated.evidence.cached(cycle_of)
    return PlayedExample(document, _bad(result), cycle, len({*result.chains.values()}))


def _bad(result: Result) -> dict[str, Judgement]:
    return {key: result.judgements[key] for key in result.bad}


def keep(
    played: PlayedExample, path: Path, bounds: Bounds, instants: int, sentences: Sequence[str]
) -> ViolationExample:
    """Write a played scenario to `path`, with `sentences` as its comment, and return it as an example."""
    comment = [
        *sentences,
        f"A shortest path within {bounds.in_words()}.",
        *evidence_lines(played.judged),
        f"  ucp-harness run {path} --backend sim --seed {SEED}",
    ]
    return ViolationExample(
        write_new_file(path, to_yaml(played.document, comment)), instants, played.judged, played.chains
    )

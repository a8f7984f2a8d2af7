"""Print digests of results of the harness as JSON, with the modules in use: `python -m tests.harness.compiled_results`.

`test_compiled.py` runs this program with compiled modules and with their sources, and compares the digests. Arguments
limit the program to some kinds of results.
"""

import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from docs.generate.wrong_agents.quirky import PROBABILITY
from harness import compiled
from harness.errors import HarnessError
from harness.proof import Bounds, prove
from harness.run.simulate import simulate
from harness.scenario import Scenario, load_scenario
from tests.harness.play.test_simulation import digest
from ucp.quirks import QUIRKS

SEEDS = 50
PARTITION = [{"at_s": 150, "partition": [[1, 2], [3, 4, 5]]}, {"at_s": 300, "heal": True}]
BOUNDS = {
    "lossless": Bounds(3, 2, "lossless"),
    "lossy": Bounds(3, 2, "lossy"),
    "whole": Bounds(2, 2, "lossy", reduced=False),
    "any": Bounds(2, 2, "any"),
    "faults": Bounds(2, 2, "lossless", ("duplicate", "death")),
    "clocks": Bounds(2, 2, "lossy", clocks_any=True, steps=True),
    "quirk": Bounds(3, 2, "lossy", quirks={"stale_chain_hash": True}),
    "captured": Bounds(2, 1, "lossy", captured=1),
}


def played(scenario: Scenario, seed: int, *, tracing: bool = True) -> str:
    """Return a digest of exports, figures, traces and all judgements with their evidence."""
    simulated = simulate(scenario, seed, tracing=tracing)
    judgements = {key: repr(judgement) for key, judgement in simulated.result.judgements.items()}
    return hashed([digest(simulated), judgements])


def hashed(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, default=str).encode()).hexdigest()[:16]


def runs() -> Iterator[tuple[str, str]]:
    five = Scenario.model_validate({"name": "five", "network": {"loss": 0.2}, "duration_s": 600})
    for seed in range(SEEDS):
        yield f"seed {seed}", played(five, seed)
        yield f"seed {seed} without traces", played(five, seed, tracing=False)


def library() -> Iterator[tuple[str, str]]:
    for path in sorted(Path(compiled.ROOT, "scenarios").glob("*.yaml")):
        try:
            scenario = load_scenario(path)
            if len(scenario.roster) <= 8:
                yield path.stem, played(scenario, 1)
        except HarnessError as error:
            yield path.stem, str(error)


def wrong_agents() -> Iterator[tuple[str, str]]:
    mission = Scenario.model_validate(
        {"name": "wrong", "network": {"loss": 0.3}, "duration_s": 500, "timeline": PARTITION, "final_reconcile": True}
    )
    for name, quirk in QUIRKS.items():
        wrong = mission.model_copy(update={"quirks": {name: PROBABILITY if quirk.chance else True}})
        yield name, played(wrong, 1)


def proofs() -> Iterator[tuple[str, str]]:
    with TemporaryDirectory() as directory, chdir(directory):  # the results contain the paths of the examples
        for name, bounds in BOUNDS.items():
            document = prove(bounds, out=Path(f"{name}.yaml")).to_json()
            examples = {path.name: path.read_text() for path in sorted(Path().glob("*.yaml"))}
            times = ("seconds", "processor_s")
            yield name, hashed([{key: value for key, value in document.items() if key not in times}, examples])


KINDS: dict[str, Callable[[], Iterator[tuple[str, str]]]] = {
    "runs": runs,
    "library": library,
    "wrong agents": wrong_agents,
    "proofs": proofs,
}


def main() -> None:
    results = {kind: dict(KINDS[kind]()) for kind in sys.argv[1:] or KINDS}
    json.dump({"modules": compiled.in_use, **results}, sys.stdout)


if __name__ == "__main__":
    main()

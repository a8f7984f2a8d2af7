"""The library, played plain and with keys: `python -m benchmarks.secured_library [--seeds 8] [SCENARIO ...]`.

In virtual time, seed for seed: all agents have to leave the same chains, block hash for block hash, with keys and
without. A matrix is played at each of its rates of loss. What cannot be compared is left out of both, and told: what a
rogue node injects is believed by some agents without keys and dropped with them, and without keys nobody is revoked.
Exit status 1, and the scenario's name, where chains differ.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from harness.errors import HarnessError
from harness.run.parallel import Failed, cores, sweep
from harness.run.simulate import simulate
from harness.scenario import Scenario, load, load_scenario, read_yaml
from harness.sweep.matrix._matrix_file import load_matrix

INJECTIONS = "what its rogue node injects, of which agents with keys believe less"
REVOCATIONS = "its revocations, which nobody without keys hears"
SEALING = "the sealing of event data, which is in the hashes"


class Compared(NamedTuple):
    """A scenario to play both ways; `without` what cannot be compared."""

    name: str
    scenario: Scenario
    without: tuple[str, ...]


def in_both(name: str, scenario: Scenario) -> Compared:
    """As much of the scenario as means the same with keys and without."""
    timeline = [entry for entry in scenario.timeline if not entry.injection]
    heard = [entry for entry in timeline if not (entry.fault and entry.fault.needs_keys)]
    left_out = {
        INJECTIONS: len(timeline) < len(scenario.timeline),
        REVOCATIONS: len(heard) < len(timeline),
        SEALING: scenario.security is not None and scenario.security.seal,
    }
    plain = scenario.model_copy(update={"timeline": heard, "security": None})
    return Compared(name, plain, tuple(reason for reason, is_left_out in left_out.items() if is_left_out))


def all_of(names: Sequence[str]) -> Iterator[Compared]:
    """Raises ScenarioError for a file that is none."""
    for name in names:
        path = load.find(Path(name))
        if "loss" not in read_yaml(path, "scenario"):
            yield in_both(name, load_scenario(path))
            continue
        matrix = load_matrix(path, "sim")
        for point in matrix.points:
            yield in_both(f"{name}, loss {point.loss:g}", matrix.scenario_at(point))


def difference(task: tuple[Compared, int]) -> str | None:
    """Where the chains with keys are not those without; None if they are the same, each with all its blocks."""
    (_, plain, _), seed = task
    without, keyed = (simulate(scenario, seed).result.chains for scenario in (plain, plain.secured()))
    for agent_id in sorted(without.keys() | keyed.keys()):
        ours, theirs = without.get(agent_id), keyed.get(agent_id)
        if ours is None or theirs is None:
            return f"agent {agent_id} leaves no chain {'without' if ours is None else 'with'} keys"
        if ours != theirs:
            parted = next((at for at, both in enumerate(zip(ours, theirs, strict=False)) if both[0] != both[1]), None)
            at = min(len(ours), len(theirs)) if parted is None else parted
            return f"agent {agent_id} has other blocks from {at + 1} on, of {len(ours)} without and {len(theirs)} with"
    return None


def compare(asked: Sequence[Compared], seeds: range, jobs: int) -> dict[str, list[str]]:
    """Scenario -> how seeds differ."""
    different: dict[str, list[str]] = defaultdict(list)
    tasks = [(compared, seed) for compared in asked for seed in seeds]
    with sweep(tasks, difference, jobs, what="missions" if sys.stderr.isatty() else None) as outcomes:
        for (compared, seed), outcome in outcomes:
            if isinstance(outcome, Failed):
                different[compared.name].append(f"seed {seed}: {outcome.reason}")
            elif outcome is not None:
                different[compared.name].append(f"seed {seed}: {outcome}")
    return different


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8, help="1..N")
    parser.add_argument("--jobs", type=int, default=cores())
    parser.add_argument("scenarios", nargs="*", default=load.names())
    arguments = parser.parse_args()
    seeds = range(1, arguments.seeds + 1)
    try:
        asked = list(all_of(arguments.scenarios))
        different = compare(asked, seeds, arguments.jobs)
    except HarnessError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_status
    for name, _, without in asked:
        said = ", without ".join(["different" if name in different else "the same", *without])
        sys.stdout.write(f"{name:28} {said}\n")
        for line in different.get(name, []):
            sys.stdout.write(f"    {line}\n")
    sys.stdout.write(f"{len(asked)} scenarios with {len(seeds)} seeds, {len(different)} different\n")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())

"""Play all included scenarios with and without keys: `python -m benchmarks.secured_library [--seeds 8] [SCENARIO ...]`.

In virtual time, with the same seed, all agents must export the same chains with keys and without: the same block hashes
in the same order. A matrix is played at each of its loss rates. Without arguments the benchmark leaves out
`growth_matrix`, because its swarms of 100 agents take hours with keys. Some parts of a scenario cannot be compared. The
benchmark removes these parts from both runs, and prints their names. These are injections, because agents with keys
drop them, revocations, because they need keys, and restarts, because agents with keys then wait for echoes. If chains
differ, the benchmark prints the name of the scenario, and the exit status is 1.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from harness.errors import HarnessError
from harness.run.parallel import FailedTask, cores, sweep
from harness.run.simulate import simulate
from harness.scenario import Scenario, load, load_scenario, read_yaml
from harness.sweep.matrix._matrix_file import load_matrix

INJECTIONS = "injections, which agents with keys drop"
REVOCATIONS = "revocations, which need keys"
RESTARTS = "restarts, after which agents with keys wait for echoes"
SEALING = "sealed event data, which changes the hashes"
TOO_LARGE = "growth_matrix"
"""The matrix that takes hours with keys, because it has swarms of 100 agents."""


class Compared(NamedTuple):
    """A scenario to play with and without keys. `without` lists the parts that were removed because they cannot be
    compared.
    """

    name: str
    scenario: Scenario
    without: tuple[str, ...]


def in_both(name: str, scenario: Scenario) -> Compared:
    """Remove the parts of a scenario that have a different meaning with keys. Return the rest and the names of these
    parts.
    """
    timeline = [entry for entry in scenario.timeline if not entry.injection]
    heard = [entry for entry in timeline if not (entry.fault and entry.fault.needs_keys)]
    alive = [entry for entry in heard if not (entry.fault and entry.fault.what in ("restart", "reboot"))]
    left_out = {
        INJECTIONS: len(timeline) < len(scenario.timeline),
        REVOCATIONS: len(heard) < len(timeline),
        RESTARTS: len(alive) < len(heard),
        SEALING: scenario.security is not None and scenario.security.seal,
    }
    plain = scenario.model_copy(update={"timeline": alive, "security": None})
    return Compared(name, plain, tuple(reason for reason, is_left_out in left_out.items() if is_left_out))


def all_of(names: Sequence[str]) -> Iterator[Compared]:
    """Yield all scenarios to compare. Raises ScenarioError for an invalid file."""
    for name in names:
        path = load.find_file(Path(name))
        if "loss" not in read_yaml(path, "scenario"):
            yield in_both(name, load_scenario(path))
            continue
        matrix = load_matrix(path, "sim")
        for point in matrix.points:
            yield in_both(f"{name}, loss {point.loss:g}", matrix.scenario_at(point))


def difference(task: tuple[Compared, int]) -> str | None:
    """Play the scenario with and without keys. Return the first difference between the chains, or None if they are
    equal.
    """
    (_, plain, _), seed = task
    without, keyed = (simulate(scenario, seed).result.chains for scenario in (plain, plain.secured()))
    for agent_id in sorted(without.keys() | keyed.keys()):
        ours, theirs = without.get(agent_id), keyed.get(agent_id)
        if ours is None or theirs is None:
            return f"agent {agent_id} exports no chain {'without' if ours is None else 'with'} keys"
        if ours != theirs:
            parted = next((at for at, both in enumerate(zip(ours, theirs, strict=False)) if both[0] != both[1]), None)
            at = min(len(ours), len(theirs)) if parted is None else parted
            lengths = f"{len(ours)} blocks without and {len(theirs)} with keys"
            return f"agent {agent_id} has other blocks from block {at + 1} ({lengths})"
    return None


def compare(asked: Sequence[Compared], seeds: range, jobs: int) -> dict[str, list[str]]:
    """Return the seeds with a difference, for each scenario that has such a seed."""
    different: dict[str, list[str]] = defaultdict(list)
    tasks = [(compared, seed) for compared in asked for seed in seeds]
    with sweep(tasks, difference, jobs, what="missions" if sys.stderr.isatty() else None) as outcomes:
        for (compared, seed), outcome in outcomes:
            if isinstance(outcome, FailedTask):
                different[compared.name].append(f"seed {seed}: {outcome.reason}")
            elif outcome is not None:
                different[compared.name].append(f"seed {seed}: {outcome}")
    return different


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8, help="number of seeds, from 1")
    parser.add_argument("--jobs", type=int, default=cores(), help="number of parallel missions")
    scenarios = [name for name in load.scenario_names() if name != TOO_LARGE]
    parser.add_argument("scenarios", nargs="*", default=scenarios, help=f"scenarios; default: all but {TOO_LARGE}")
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

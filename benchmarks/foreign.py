"""Measure the speed of agents in another language in virtual time: `python -m benchmarks.foreign [-- COMMAND...]`.

COMMAND starts the agent. Without COMMAND, the benchmark uses the harness's own agent as a separate program. The
missions have 20 minutes, five agents and 15 % loss. They run on `--jobs` cores with traces and all checks. For
comparison, the same missions also run with the harness's own agent inside the simulation.

`--same SEEDS` instead plays all scenarios of the library with some seeds. It prints the missions in which the agent
exports other chains, or gets other verdicts, than the harness's own agent inside the simulation. If COMMAND is the
harness's own agent, the traces must also be equal. A swarm does not count if the harness proves that it never finishes,
because the harness cannot prove this for agents whose state it does not know.
"""

import argparse
import resource
import sys
import time
from collections import Counter
from pathlib import Path

from harness.errors import UnsupportedError
from harness.play.simulation.foreign._program_pool import SHARED
from harness.run.parallel import FailedTask, sweep
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario, load, load_scenario

OURS = [sys.executable, "-P", "-m", "ucp.node"]


def of_library(name: str, command: list[str] | None) -> Scenario:
    return load_scenario(Path(name)).model_copy(update={"agent_command": command})


def measure(scenario: Scenario, missions: int, jobs: int) -> tuple[float, int]:
    """Return the wall time of all missions in seconds, and the total number of handler runs."""

    def work(seed: int) -> int:
        result = simulate(scenario, seed, tracing=True, deliver_all=True)
        assert not result.result.bad, f"seed {seed}: {result.result.bad}"
        return sum(len(trace.runs) for trace in result.evidence.traces.values())

    began, runs = time.monotonic(), 0
    with sweep(range(missions), work, jobs) as outcomes:
        for seed, outcome in outcomes:
            if isinstance(outcome, FailedTask):
                sys.exit(f"seed {seed}: {outcome.reason}")
            runs += outcome
    return time.monotonic() - began, runs


def processor_s(scenario: Scenario, missions: int = 10) -> tuple[float, float]:
    """Return the processor seconds of this process and of the agents for one mission, without the agents' start."""

    def used(who: int) -> float:
        usage = resource.getrusage(who)
        return usage.ru_utime + usage.ru_stime

    spent = []
    for count in (1, 1 + missions):  # the first alone is mostly their start
        before = used(resource.RUSAGE_SELF), used(resource.RUSAGE_CHILDREN)
        for seed in range(count):
            simulate(scenario, seed, tracing=True, deliver_all=True)
        SHARED.close()
        spent.append((used(resource.RUSAGE_SELF) - before[0], used(resource.RUSAGE_CHILDREN) - before[1]))
    (ours, theirs), (ours_of_all, theirs_of_all) = spent
    return (ours_of_all - ours) / missions, (theirs_of_all - theirs) / missions


def left_behind(simulated: Simulated, *, with_traces: bool) -> object:
    exports = [export.model_dump() for export in simulated.evidence.exports.values()]
    traces = simulated.evidence.traces.values() if with_traces else ()
    return exports, simulated.result.to_json(), [[run.to_line() for run in trace.runs] for trace in traces]


def same(command: list[str], seeds: int, jobs: int) -> int:
    """Return the number of missions in which the agents of COMMAND behave differently from the harness's own agents."""

    def work(task: tuple[str, int]) -> str:
        name, seed = task
        ours = simulate(of_library(name, None), seed, tracing=True, deliver_all=True)
        try:
            driven = simulate(of_library(name, command), seed, tracing=True)
        except UnsupportedError:
            return "not supported"
        if ours.played.cycle is not None:
            return "never finishes"
        alike = (left_behind(each, with_traces=command == OURS) for each in (ours, driven))
        return "the same" if next(alike) == next(alike) else "different"

    came_to: Counter[str] = Counter()
    names = [name for name in load.scenario_names() if not name.endswith("matrix")]
    tasks = [(name, seed) for name in names for seed in range(seeds)]
    with sweep(tasks, work, jobs, what="missions") as outcomes:
        for (name, seed), outcome in outcomes:
            what = outcome.reason if isinstance(outcome, FailedTask) else outcome
            came_to[what] += 1
            if what != "the same":
                sys.stdout.write(f"{name}, seed {seed}: {what}\n")
    sys.stdout.write(f"of {len(tasks)} missions {dict(came_to)}\n")
    return len(tasks) - sum(came_to[what] for what in ("the same", "never finishes", "not supported"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--missions", type=int, default=200, help="number of missions")
    parser.add_argument("--jobs", type=int, default=2, help="number of parallel missions")
    parser.add_argument("--same", type=int, default=0, metavar="SEEDS", help="play the library with seeds 0..SEEDS-1")
    parser.add_argument("command", nargs="*", default=OURS)
    asked = parser.parse_args()
    if asked.same:
        return 1 if same(asked.command, asked.same, asked.jobs) else 0
    for words, command in (("in the simulation", None), (" ".join(asked.command), asked.command)):
        # Workers that `measure` leaves behind would count as agents, so it goes last.
        ours_s, theirs_s = processor_s(of_library("loss_15", command))
        wall_s, runs = measure(of_library("loss_15", command), asked.missions, asked.jobs)
        rate = f"{asked.missions / wall_s * 60:.0f} missions a minute, {runs / wall_s:.0f} handler runs a second"
        cost = f"{1000 * ours_s:.0f} ms of a processor a mission, and {1000 * theirs_s:.0f} ms the agents"
        sys.stdout.write(f"{words}: {asked.missions} missions in {wall_s:.1f} s, {rate}; {cost}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Measure how many handler runs per second the checker compares on one processor core, and the size of records.

    python -m benchmarks.judging [ROUNDS]

The records come from scenarios/loss_15.yaml in virtual time, with 5, 20 and 50 agents. The size of a record is the size
of the traces on disk in bytes.
"""

import statistics
import sys
import time
from pathlib import Path

from harness.checker import steps
from harness.run.simulate import simulate
from harness.scenario import Scenario, load_scenario

SCENARIO = Path(__file__).parent.parent / "scenarios" / "loss_15.yaml"
AGENTS = (5, 20, 50)
MEAN_S = 30.0
"""Mean seconds between two events of an agent in a swarm of five. Larger swarms have the same total rate of events."""


def scenario(agents: int) -> Scenario:
    document = load_scenario(SCENARIO).model_dump()
    document |= {"agents": agents, "events": {"source": "random", "mean_s": MEAN_S * agents / 5}, "expect": None}
    return Scenario.model_validate(document)


def main(arguments: list[str]) -> int:
    rounds = int(arguments[0]) if arguments else 5
    sys.stdout.write(f"{'agents':>8}{'handler runs':>14}{'a second':>32}{'bytes of a line':>17}\n")
    for agents in AGENTS:
        evidence = simulate(scenario(agents), 1, tracing=True).evidence
        runs = [run for trace in evidence.traces.values() for run in trace.runs]
        rates = []
        for _ in range(rounds):
            began = time.process_time()
            assert steps.check(evidence).verdict == "as specified"
            rates.append(len(runs) / (time.process_time() - began))
        rate = f"{statistics.median(rates):,.0f} ({min(rates):,.0f}..{max(rates):,.0f})"
        bytes_of_a_line = sum(len(run.to_line()) for run in runs) / len(runs)
        sys.stdout.write(f"{agents:>8}{len(runs):>14,}{rate:>32}{bytes_of_a_line:>17.0f}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

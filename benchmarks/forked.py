"""Count the swarms that never become idle after a partition, for each protocol correction: `python -m
benchmarks.forked`.

A random partition divides 3 to 8 agents into groups, in which they complete some blocks. Then the partition ends. No
messages are lost otherwise. The agents complete one to three more blocks, and have 20 minutes to become idle. In half
of the runs each message takes 20 ms, in the others 2 to 50 ms. The benchmark repeats the same runs with each protocol
correction of docs/explanation/livelocks.md.
"""

import argparse
import sys
from random import Random
from typing import Any

from docs.generate.cures import STAGGER
from harness.run.parallel import FailedTask, cores, sweep
from harness.run.simulate import simulate
from harness.scenario import Scenario

TOP, ASKS, BLOCK = {"top_needs_majority": True}, {"asks_after_commit": True}, {"phase2_tie": "block"}
PHASE_1 = {"phase1_timeout_s": 0.5}
CURES: dict[str, dict[str, Any]] = {
    "none": {},
    "phase2_tie: block": {"settings": BLOCK},
    "stagger phase 1": {"stagger": PHASE_1},
    "stagger": {"stagger": STAGGER},
    "asks_after_commit, stagger": {"settings": ASKS, "stagger": STAGGER},
    "top_needs_majority": {"settings": TOP},
    "top_needs_majority, stagger": {"settings": TOP, "stagger": STAGGER},
    "all three": {"settings": TOP | ASKS, "stagger": STAGGER},
}
HEALS_S = 75.0
VOTE_S = 10.0


def scenario(seed: int, cure: dict[str, Any]) -> Scenario:
    lots = Random(seed)
    agents = lots.randint(3, 8)
    order = lots.sample(range(1, agents + 1), agents)
    parts = [[agent] for agent in order[: lots.randint(2, agents)]]
    for agent in order[len(parts) :]:
        lots.choice(parts).append(agent)
    script = []
    for part in parts:
        at_s = 1.0
        for _ in range(lots.choice((0, 1, 1, 2))):
            at_s += lots.uniform(0, 20)
            script.append({"at_s": round(at_s, 3), "agent": lots.choice(part)})
            at_s += VOTE_S
    at_s = HEALS_S
    for _ in range(lots.randint(1, 3)):
        at_s += lots.uniform(1, 30)
        script.append({"at_s": round(at_s, 3), "agent": lots.randint(1, agents)})
    settings = {"max_block_bytes": 267} | cure.get("settings", {})
    return Scenario.model_validate(
        {
            "name": "forked",
            "agents": agents,
            "duration_s": at_s + 1,
            "timeline": [{"at_s": 0.5, "partition": sorted(map(sorted, parts))}, {"at_s": HEALS_S, "heal": True}],
            "events": {"source": "scripted", "script": sorted(script, key=lambda event: event["at_s"])},
            "settle": {"limit_s": 1200},
            "network": {"delay": 0.02} if lots.random() < 0.5 else {},
            **cure,
            "settings": settings,
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=4000, help="number of runs for each cure")
    parser.add_argument("--jobs", type=int, default=cores(), help="number of parallel runs")
    parser.add_argument("--cure", nargs="+", choices=CURES, default=list(CURES), help="cures to play")
    arguments = parser.parse_args()
    for name in arguments.cure:

        def play(seed: int, cure: dict[str, Any] = CURES[name]) -> tuple[bool, int]:
            run = simulate(scenario(seed, cure), seed)
            return run.played.settled, len({*run.result.chains.values()})

        restless, uniform = [], 0
        with sweep(range(arguments.runs), play, arguments.jobs) as outcomes:
            for seed, outcome in outcomes:
                if isinstance(outcome, FailedTask):
                    raise SystemExit(f"{name}, seed {seed}: {outcome.reason}")
                settled, chains = outcome
                uniform += chains == 1
                if not settled:
                    restless.append(seed)
        words = f"{len(restless)} of {arguments.runs} never idle, {uniform} with one chain"
        seeds = f"; seeds {', '.join(map(str, sorted(restless)[:5]))}" if restless else ""
        sys.stdout.write(f"{name:30}{words}{seeds}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()

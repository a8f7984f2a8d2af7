"""Check thousands of different runs of correct agents. No check may report a finding.

    python -m benchmarks.clean_runs [RUNS] [FIRST]

The number of a run determines its scenario: 2 to 12 agents, loss, bursts, partitions, kills and restarts, pauses,
clocks that drift, and readings of the thesis. The benchmark prints each finding with the number of its run. With
findings, the exit status is 1.
"""

import sys
import time
from collections import Counter
from random import Random
from typing import Any

from harness.run.parallel import FailedTask, sweep
from harness.run.simulate import simulate
from harness.scenario import Scenario
from ucp.settings import ALTERNATIVES, CHOICES

JOBS = 2


def scenario(number: int) -> Scenario:
    draw = Random(number)
    agents = draw.choice([2, 3, 4, 5, 5, 5, 6, 8, 12])
    duration_s = draw.choice([300, 600, 1200])
    document: dict[str, Any] = {
        "name": f"clean run {number}",
        "agents": agents,
        "duration_s": duration_s,
        "network": {"loss": draw.choice([0.0, 0.0, 0.05, 0.15, 0.15, 0.25, 0.4])},
        "events": {"source": "random", "mean_s": draw.choice([20.0, 30.0, 60.0]) * agents / 5},
        "final_reconcile": True,
        "timeline": [*_partition(draw, agents, duration_s), *_death(draw, agents, duration_s)],
    }
    if draw.random() < 0.2:
        document["network"] = {"loss": {"p": 0.02, "r": 0.3}, "duplicate": 0.1, "reorder": 0.1, "delay": 0.2}
    if draw.random() < 0.2:
        document["clocks"] = {1: {"offset_s": draw.uniform(-2, 2), "drift": draw.uniform(-0.01, 0.01)}}
    if draw.random() < 0.3:
        document["settings"] = draw.choice(
            [
                *({name: value} for name, value in ALTERNATIVES.values() if CHOICES[name].is_reading),
                {"max_block_bytes": 512},
                {"finalize_gap_s": 0},
            ]
        )
    return Scenario.model_validate(document)


def _partition(draw: Random, agents: int, duration_s: float) -> list[dict[str, Any]]:
    if draw.random() < 0.5:
        return []
    ids = list(range(1, agents + 1))
    draw.shuffle(ids)
    apart = sorted(ids[: draw.randint(1, agents - 1)])
    at_s = round(duration_s * draw.uniform(0.1, 0.5), 1)
    return [{"at_s": at_s, "partition": [apart]}, {"at_s": round(at_s + duration_s / 4, 1), "heal": True}]


def _death(draw: Random, agents: int, duration_s: float) -> list[dict[str, Any]]:
    struck, at_s = draw.randint(1, agents), round(duration_s * draw.uniform(0.2, 0.6), 2)
    back_s = round(at_s + duration_s / 5, 2)
    return draw.choice(
        [
            [],
            [],
            [{"at_s": at_s, "kill": [struck]}],
            [{"at_s": at_s, "kill": [struck]}, {"at_s": back_s, "restart": [struck]}],
            [{"at_s": at_s, "reboot": [struck], "down_s": 30, "disk": draw.choice(["kept", "lost"])}],
            [{"at_s": at_s, "pause": [struck]}, {"at_s": back_s, "resume": [struck]}],
        ]
    )


def judge(number: int) -> tuple[list[str], dict[str, str]]:
    """Return a sentence for each bad verdict, and all verdicts."""
    result = simulate(scenario(number), number, tracing=True).result
    bad = [f"{key}: {judgement.verdict}: {judgement.reason}" for key, judgement in result.judgements.items()]
    verdicts = {key: judgement.verdict for key, judgement in result.judgements.items()}
    return [sentence for key, sentence in zip(result.judgements, bad, strict=True) if key in result.bad], verdicts


def say(sentence: str) -> None:
    sys.stdout.write(sentence + "\n")
    sys.stdout.flush()


def main(arguments: list[str]) -> int:
    runs, first = (int(argument) for argument in [*arguments, *("10000", "1")[len(arguments) :]])
    began, findings = time.monotonic(), 0
    counts: Counter[tuple[str, str]] = Counter()
    with sweep(range(first, first + runs), judge, JOBS, what="runs" if sys.stderr.isatty() else None) as outcomes:
        for number, outcome in outcomes:
            if isinstance(outcome, FailedTask):
                findings += 1
                say(f"run {number} failed: {outcome.reason}")
                continue
            bad, verdicts = outcome
            counts.update(verdicts.items())
            findings += bool(bad)
            for sentence in bad:
                say(f"run {number}: {sentence[:400]}")
    for (key, verdict), count in sorted(counts.items()):
        say(f"{key:9} {verdict:15} {count}")
    say(f"{runs} runs in {time.monotonic() - began:.0f} s on {JOBS} processors: {findings} with a finding")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

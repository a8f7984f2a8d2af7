"""Play and judge thousands of different runs of correct agents. No check may report a finding.

    python -m benchmarks.clean_runs [RUNS] [--first NUMBER] [--processes]

The number of a run determines its scenario: 2 to 12 agents, loss, bursts, delays, duplicates, partitions, kills and
restarts, reboots, pauses, clocks that drift, keys, a shared channel, and readings of the thesis. Each run is written to
a directory, and the checker judges the files of this directory. The benchmark prints each finding with the number of
its run. The exit status is 1 if a check reports a finding.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from harness.backend_names import BackendName
from harness.checker.judgement import Judgement
from harness.run.parallel import FailedTask, cores, sweep
from harness.run.run import run
from harness.scenario import Scenario
from netem.channel import PRESETS
from ucp.settings import ALTERNATIVES, CHOICES


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


def varied(number: int) -> Scenario:
    """Return the scenario of a run.

    In half of the runs it is the scenario that `scenario` returns. In the other runs it has other conditions, such as
    delays, links, keys or a shared channel.
    """
    drawn = scenario(number).model_dump(mode="json", exclude_defaults=True, by_alias=True)
    draw = Random(f"varied {number}")
    kind = draw.choice(["", "", "", "", "delay", "links", "security", "channel"])
    if kind == "delay":
        mean_s = draw.choice([0.05, 0.5, 2.0])
        distribution = draw.choice(["uniform", "normal", "pareto", "paretonormal"])
        delay = {"mean_s": mean_s, "jitter_s": mean_s * draw.random(), "distribution": distribution}
        drawn["network"] = {"loss": 0.1, "delay": delay, "duplicate": 0.05, "reorder": 0.1, "corrupt": 0.02}
    elif kind == "links":
        drawn["network"] = {
            "rate": draw.choice([2000, 20_000]),
            "limit": 20,
            "links": [{"from": 1, "to": 2, "loss": 0.8}],
        }
        drawn["schedule"] = [{"nemesis": draw.choice(["halves", "isolate", "flapping"]), "every_s": 60, "for_s": 30}]
    elif kind == "security":
        drawn["security"] = {"seal": draw.random() < 0.3}
    elif kind == "channel":
        preset = draw.choice(list(PRESETS))
        drawn["network"] = {"channel": {"preset": preset}, "loss": draw.choice([0.0, 0.1])}
        if preset.startswith("lora"):
            drawn["settings"] = {"max_block_bytes": 150, "max_event_bytes": 100}
    return Scenario.model_validate(drawn)


def of_processes(number: int) -> Scenario:
    """Return the scenario of a run whose agents are processes. It has 2 to 6 agents and takes 300 mission seconds."""
    draw = Random(f"processes {number}")
    agents, lost = draw.randint(2, 6), draw.choice([0.0, 0.15, 0.3])
    document: dict[str, Any] = {
        "name": f"clean run {number} of processes",
        "agents": agents,
        "duration_s": 300,
        "vehicles": {"kind": "none"},
        "network": {"loss": lost},
        "events": {"source": "random", "mean_s": 10},
        "timeline": [*_partition(draw, agents, 300), *_death(draw, agents, 300)],
        "final_reconcile": True,
    }
    if draw.random() < 0.2:
        document["security"] = {}
    elif draw.random() < 0.2:
        document |= {"network": {"channel": {"preset": "wifi_1"}}, "vehicles": {"kind": "embedded"}}
    return Scenario.model_validate(document)


def judge(backend: BackendName, number: int) -> tuple[list[str], dict[str, str]]:
    """Play and judge a run. Return a sentence for each bad verdict, and all verdicts."""
    with tempfile.TemporaryDirectory(prefix="clean-run-") as directory:
        asked = varied(number) if backend == "sim" else of_processes(number)
        result = run(asked, number, Path(directory, "run"), backend=backend).result
    verdicts = {key: judgement.verdict for key, judgement in result.judgements.items()}
    judged = {key: judgement for key, judgement in result.judgements.items() if key in result.bad}
    bad = [f"{key}: {judgement.verdict}: {judgement.reason}{_first(judgement)}" for key, judgement in judged.items()]
    return bad, verdicts


def _first(judgement: Judgement) -> str:
    """Return the first piece of evidence of a judgement, or an empty text if it has no evidence."""
    return f"; {judgement.evidence[0].detail}" if judgement.evidence else ""


def say(sentence: str) -> None:
    sys.stdout.write(sentence + "\n")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=int, nargs="?", default=10_000)
    parser.add_argument("--first", type=int, default=1, help="number of the first run")
    parser.add_argument("--jobs", type=int, default=cores(), help="number of processes that play runs in virtual time")
    parser.add_argument("--processes", action="store_true", help="agents run as processes, one run after the other")
    asked = parser.parse_args()
    backend: BackendName = "process" if asked.processes else "sim"
    jobs = 1 if asked.processes else asked.jobs
    began, findings = time.monotonic(), 0
    counts: Counter[tuple[str, str]] = Counter()
    numbers = range(asked.first, asked.first + asked.runs)
    with sweep(numbers, partial(judge, backend), jobs, what="runs" if sys.stderr.isatty() else None) as outcomes:
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
    say(f"{asked.runs} runs in {time.monotonic() - began:.0f} s on {jobs} processors: {findings} with a finding")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())

"""Measure the process of a shared channel in real time: `python -m benchmarks.live_channel [--agents 5 20 50]`.

Each row is one run with processes and embedded vehicles. The processor time is that of the channel process alone, as a
share of the time of one core during the mission. The lateness is the delay of the deliveries by the channel process, in
mission time. Agents that wait for a processor answer later, so fewer answers collide than in virtual time. The last
columns have the time from a query to its answer, and the share of lost copies. The number in parentheses is the share
of lost copies in virtual time.
"""

import argparse
import tempfile
from pathlib import Path

from benchmarks.simulation import print_row
from harness.archive.run_record import ChannelRecord
from harness.run.run import run
from harness.run.simulate import simulate
from harness.scenario import Scenario


def scenario(agents: int, duration_s: float, speedup: float, preset: str) -> Scenario:
    return Scenario.model_validate(
        {
            "name": "benchmark",
            "agents": agents,
            "duration_s": duration_s,
            "speedup": speedup,
            "vehicles": {"kind": "embedded"},
            "events": {"source": "random", "mean_s": 10},
            "network": {"channel": {"preset": preset}},
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, nargs="+", default=[5, 20, 50], help="numbers of agents")
    parser.add_argument("--duration", type=float, default=60.0, help="mission seconds")
    parser.add_argument("--speedups", type=float, nargs="+", default=[1.0, 10.0], help="speedups")
    parser.add_argument("--preset", default="wifi_6", help="preset of the channel")
    arguments = parser.parse_args()
    print_row(
        "agents", "speedup", "frames", "deliveries", "core", "late, median", "late, 95 %", "answer, 95 %", "lost copies"
    )
    for agents in arguments.agents:
        for speedup in arguments.speedups:
            row(scenario(agents, arguments.duration, speedup, arguments.preset))


def row(asked: Scenario) -> None:
    with tempfile.TemporaryDirectory() as folder:
        played = run(asked, seed=1, out=Path(folder, "run"), backend="process")
    channel = played.record.channel
    assert channel is not None and channel.lateness is not None, played.record.outcome_detail
    late, wall_s = channel.lateness, (played.record.mission_s or 0.0) / asked.speedup
    virtual = ChannelRecord.model_validate(simulate(asked, 1).played.channel)
    print_row(
        str(len(asked.roster)),
        f"{asked.speedup:g}",
        str(channel.frames),
        str(late.deliveries),
        f"{late.processor_s / wall_s:.1%}",
        f"{1000 * late.median_s:.2f} ms",
        f"{1000 * late.p95_s:.2f} ms",
        "-" if channel.answers is None else f"{1000 * channel.answers.p95_s:.0f} ms",
        f"{lost(channel, asked):.1%} ({lost(virtual, asked):.1%})",
    )


def lost(channel: ChannelRecord, asked: Scenario) -> float:
    """Return the share of the copies of frames that the channel lost."""
    copies = channel.frames * (len(asked.roster) - 1)
    return sum(sum(counts.values()) for counts in channel.lost.values()) / copies if copies else 0.0


if __name__ == "__main__":
    main()

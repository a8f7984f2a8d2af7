"""Measure `replay` with a long record: its start, its speed, and a single step back.

    python -m benchmarks.replaying [ROUNDS]

The record is the trace of one of 20 agents in a run of two hours in virtual time. The trace contains all messages that
the agent received at 15 % loss. The directory also has the traces of the other agents, but no run.json. `open` is the
duration of the whole command, from its start to the first prompt, including its end.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from benchmarks.judging import scenario
from harness.archive.directory import RunDirectory
from harness.field.replay import RecordedTrace, RecordPlayer, open_record
from harness.play import mission
from harness.play.simulation.run_files import DiskRecorder
from harness.play.simulation.simulation import Simulation

AGENTS, AGENT = 20, 3
DURATION_S = 7200.0
BACKS = 200


def fly(directory: Path) -> None:
    """Play a run of two hours. All messages are delivered and not omitted, so that each trace contains all inputs of
    its agent.
    """
    asked = scenario(AGENTS).model_copy(update={"duration_s": DURATION_S})
    simulation = Simulation(asked, 1, DiskRecorder(RunDirectory(directory)), deliver_all=True)
    story = mission.play(simulation, asked)
    try:
        story.send(None)
    except StopIteration:
        simulation.end()


def timed(what: Callable[[], object]) -> float:
    began = time.perf_counter()
    what()
    return time.perf_counter() - began


def opened(directory: Path) -> None:
    """Run `ucp-harness replay` like a user, until it has made one step."""
    command = [sys.executable, "-m", "harness.cli", "replay", directory, "--agent", str(AGENT), "--step"]
    subprocess.run(command, input=b"next\nquit\n", stdout=subprocess.DEVNULL, check=True)


def backs(record: RecordedTrace) -> list[float]:
    """Return the duration in seconds of single steps back from random positions in the record."""
    player, draw = RecordPlayer(record), Random(1)
    player.to_end()
    took = []
    for _ in range(BACKS):
        player.to(draw.randrange(1, len(record.entries) + 1))
        position = player.position - 1
        took.append(timed(lambda position=position: player.to(position)))  # type: ignore[misc]
    return took


def main(arguments: list[str]) -> int:
    rounds = int(arguments[0]) if arguments else 5
    with TemporaryDirectory() as name:
        directory = Path(name) / "run"
        fly(directory)
        record = open_record(directory, AGENT)
        megabytes = record.path.stat().st_size / 1e6
        whole = sum(path.stat().st_size for path in record.path.parent.glob("*.trace.jsonl")) / 1e6
        sys.stdout.write(f"{len(record.entries):,} lines, {megabytes:.0f} MB, beside {whole:.0f} MB of the others\n")
        _say("open", "s", [timed(lambda: opened(directory)) for _ in range(rounds)])
        rates = []
        for _ in range(rounds):
            player = RecordPlayer(open_record(directory, AGENT))
            rates.append(len(record.entries) / timed(lambda player=player: player.to(len(record.entries))))  # type: ignore[misc]
        _say("steps a second", "", rates)
        _say("a step back", "ms", [1000 * took for took in backs(record)])
    return 0


def _say(what: str, unit: str, figures: list[float]) -> None:
    middle = statistics.median(figures)
    sys.stdout.write(f"{what:<16}{middle:,.2f} {unit} ({min(figures):,.2f}..{max(figures):,.2f})\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

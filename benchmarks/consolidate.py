"""Measure the time and memory of `consolidate` for a large swarm whose chains agree or diverge.

python -m benchmarks.consolidate [AGENTS [BLOCKS]]
"""

import json
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ucp.agent import Agent
from ucp.block import Block
from ucp.events import LoggableEvent
from ucp.export import export_chain
from ucp.store import StoredState
from ucp.telemetry import POSITION, Position

EPOCH_US = 1_795_258_278_000_000
EVENTS_IN_A_BLOCK = 13
SHAPES = {
    "one chain": "all chains are equal",
    "two halves": "half of each chain is mutual, then two groups differ",
    "each its own": "no agent ever received a message",
}


def block(agent_id: int, number: int, lots: random.Random) -> Block:
    """Return a block with 13 position events, which fill 975 of 1,024 bytes."""
    at_us = EPOCH_US + 10_000_000 * number
    data = b""
    for event in range(EVENTS_IN_A_BLOCK):
        place = 500_000_000 + lots.randrange(10**6), 80_000_000 + lots.randrange(10**6)
        position = Position(number, at_us, *place, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0, 0, 0, 12_000, 0, 90, 0, 1)
        data += LoggableEvent(at_us + event, POSITION, position.pack()).encode()
    return Block(agent_id, at_us + EVENTS_IN_A_BLOCK, data)


def write_exports(directory: Path, agents: int, blocks: int, shape: str) -> None:
    lots = random.Random(shape)
    roster = range(1, agents + 1)
    shared = [block(1 + number % agents, number, lots) for number in range(blocks)]
    halves = [[block(1 + number % agents, number, lots) for number in range(blocks // 2, blocks)] for _ in range(2)]
    for agent_id in roster:
        chain = {
            "one chain": lambda: shared,
            "two halves": lambda agent=agent_id: shared[: blocks // 2] + halves[agent % 2],
            "each its own": lambda agent=agent_id: [block(agent, number, lots) for number in range(blocks)],
        }[shape]()
        agent = Agent(agent_id, roster, b"benchmark", tracing=False)
        own = [each.block_hash for each in chain if each.agent_id == agent_id]
        agent.boot(StoredState(own, chain), 0.0)
        document = export_chain(agent.state, EPOCH_US)
        (directory / f"{agent_id}.chain.json").write_text(json.dumps(document, indent=1))


def main() -> None:
    agents, blocks = (int(argument) for argument in (*sys.argv[1:], "100", "1000")[:2])
    for shape, words in SHAPES.items():
        with tempfile.TemporaryDirectory() as name:
            directory = Path(name)
            (directory / "exports").mkdir()
            write_exports(directory / "exports", agents, blocks, shape)
            mebibytes = sum(path.stat().st_size for path in (directory / "exports").iterdir()) / 2**20
            command = [sys.executable, "-m", "harness.cli", "consolidate", str(directory / "exports")]
            began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([*command, "-o", str(directory / "mission.jsonl")], check=True, stdout=subprocess.DEVNULL)
            seconds, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
            processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            peak = after.ru_maxrss / 1024
            record = (directory / "mission.jsonl").stat().st_size / 2**20
            sys.stdout.write(
                f"{shape} ({words}): {agents} exports of {blocks} blocks, {mebibytes:.0f} MiB: {seconds:.1f} s, "
                f"{processor:.1f} s of processor time, peak {peak:.0f} MiB so far, record {record:.0f} MiB\n"
            )


if __name__ == "__main__":
    main()

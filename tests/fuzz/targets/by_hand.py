"""Fuzz target: requests of a user to an active run.

Each line gets an answer, and the recorded scenario repeats the events. The mission is in virtual time. Mission time
stops during the requests, and then continues to the end of the mission.
"""

import asyncio
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.errors import ScenarioError
from harness.play.agent_control import connect
from harness.play.interventions import Interventions
from harness.play.request_socket import SOCKET, ask_run, serve_requests
from harness.play.simulation.simulation import Simulation
from harness.run.simulate import MemoryRecorder, simulate
from harness.scenario import Scenario
from harness.scenario.injection import INJECTIONS
from tests.fuzz.finding import require, sound

MOST_LINES = 20
LONGEST_LINE = 60_000
"""Maximum length of a line. A longer line ends the connection."""
ASKED = Scenario.model_validate({"name": "asked", "agents": 3, "duration_s": 60, "network": {"loss": 0.1}})


def run(data: bytes) -> None:
    short = [line for line in data.split(b"\n")[:MOST_LINES] if len(line) < LONGEST_LINE]
    lines = [line for line in short if not any(name.encode() in line for name in INJECTIONS)]
    hand = Interventions(ASKED, virtual_time=True, paused=True)
    memory = MemoryRecorder(tracing=True)
    simulation = Simulation(ASKED, 1, memory, interactive=True, on_progress=_yield, pace=hand.pace)
    with TemporaryDirectory() as folder:
        asyncio.run(_converse(hand, simulation, Path(folder), lines))
        require(not (Path(folder) / SOCKET).exists(), "the socket is left behind")
    simulation.end()
    chains = {agent_id: export.top_chain_hash for agent_id, export in memory.evidence(simulation).exports.items()}
    again = simulate(hand.scenario, 1).evidence.exports
    require({agent_id: export.top_chain_hash for agent_id, export in again.items()} == chains, "it is played otherwise")


async def _yield(simulation: Simulation) -> None:
    await asyncio.sleep(0)


async def _converse(hand: Interventions, simulation: Simulation, folder: Path, lines: list[bytes]) -> None:
    async def played() -> None:
        async with serve_requests(hand, folder):
            await hand.story(simulation, ASKED)

    playing = asyncio.create_task(played())
    while hand.closed is not None:
        await asyncio.sleep(0)
    reader, writer = await connect(folder / SOCKET)
    for line in lines:
        writer.write(line + b"\n")
        answer = await reader.readline()
        if not answer and hand.closed is not None:
            break  # the run was asked to continue, and has ended
        require(answer.endswith(b"\n"), f"no answer to {line[:200]!r}")
        document: Any = json.loads(answer)
        require(isinstance(document.get("ok"), bool), "the answer is none")
        if not document["ok"]:
            sound(document["error"])
    writer.close()
    with suppress(ScenarioError, OSError):  # the run may have ended
        await ask_run(folder, command="pace", factor=None)
        await ask_run(folder, command="go_on")
    await playing


def seeds(flown: Path) -> Iterator[bytes]:
    requests: list[dict[str, Any]] = [
        {"command": "state"},
        {"command": "step", "seconds": 5},
        {"command": "happen", "entry": {"partition": [[1, 2], [3]], "for_s": 20}},
        {"command": "step"},
        {"command": "happen", "entry": {"reboot": [1], "down_s": 5, "disk": "kept"}},
        {"command": "happen", "entry": {"network": {"links": [{"from": 1, "to": 2, "loss": 0.9}]}}},
        {"command": "step", "seconds": 10},
        {"command": "happen", "entry": {"heal": True}},
        {"command": "happen", "entry": {"kill": [2]}},
        {"command": "pace", "factor": 1000},
        {"command": "pause"},
    ]
    yield b"\n".join(json.dumps(request).encode() for request in requests)
    yield b'{"command":"happen"}\n{"command":"step","seconds":"1"}\nnone\n[]\n{"command":["pause"]}'

"""Play missions for tests of the checker. Real agents run in a simulated network and write the usual exports."""

import json
from pathlib import Path
from random import Random
from typing import Any

from tests.ucp.air import Air, uniform_latency
from ucp.export import export_chain
from ucp.trace import header_line


def fly(loss: float = 0.0, seed: int = 1, agents: int = 5, duration_s: float = 600.0) -> Air:
    air = Air(range(1, agents + 1), uniform_latency(Random(seed), loss=loss))
    air.generate_events(seed)
    air.run_until(duration_s)
    air.stop_events()
    air.settle()
    return air


def reconcile_all(air: Air) -> None:
    air.fate = uniform_latency(Random(9))
    for _ in range(3):
        for agent_id in air.agents:
            air.reconcile(agent_id)


def write_exports(air: Air, directory: Path, traces: bool = True) -> list[Path]:
    directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for agent_id, agent in air.agents.items():
        paths.append(directory / f"{agent_id}.chain.json")
        paths[-1].write_text(json.dumps(export_chain(agent.state, round(air.now * 1e6))))
        if traces:
            initial_data = agent.state.chain.inception.block_data
            clock = {"epoch_us": 0, "speedup": 1.0}
            header = header_line(agent_id, sorted(agent.roster), initial_data, agent.state.settings.to_json(), clock)
            lines = "".join(run.to_line() for run in air.runs[agent_id])
            (directory / f"{agent_id}.trace.jsonl").write_text(header + lines)
    return paths


def write_run(air: Air, directory: Path, network: list[dict[str, Any]], **record: Any) -> Path:
    """Write a run directory with exports, traces, and a record of the network."""
    write_exports(air, directory / "agents")
    ended = {"schema": "ucp-run/1", "outcome": "completed", "agents": {}}
    record = {**ended, "roster": list(air.agents), "network": network, **record}
    (directory / "run.json").write_text(json.dumps(record))
    return directory


CONNECTED = [{"at_s": 0.0, "what": "start", "detail": "loss 0 %", "fully_connected": True}]
LOSSY = [{"at_s": 0.0, "what": "start", "detail": "loss 15 %", "fully_connected": False}]


def edit(path: Path, change: Any) -> None:
    """Load the JSON file at `path`, let `change` edit it in place, and write it back."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def edit_lines(path: Path, change: Any) -> None:
    """Let `change` edit the list of documents in a JSON Lines file in place."""
    documents = [json.loads(line) for line in path.read_text().splitlines()]
    change(documents)
    path.write_text("".join(json.dumps(document, separators=(",", ":")) + "\n" for document in documents))

"""Write run directories for tests of the report. Chains are given as texts with the names of blocks."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.archive.exports import Export
from ucp.block import Block
from ucp.core import Core
from ucp.export import export_chain
from ucp.settings import Settings

Chains = Mapping[int, str | Sequence[str]]


def block(name: str) -> Block:
    agent_id, ordinal = (int(part) for part in name.split("."))
    return Block(agent_id, ordinal * 30_000_000 + agent_id, b"")


def documents(chains: Chains) -> dict[int, dict[str, Any]]:
    """Return the export of each agent.

    `chains` is like {1: "1.1 2.1", 2: "1.1"}. The oldest block is first.
    """
    named = {agent_id: chain.split() if isinstance(chain, str) else list(chain) for agent_id, chain in chains.items()}
    everywhere = {name for chain in named.values() for name in chain}
    exported = {}
    for agent_id, chain in named.items():
        core = Core(agent_id, b"mission", Settings())
        own = [int(name.split(".")[1]) for name in everywhere if name.startswith(f"{agent_id}.")]
        for ordinal in range(1, max(own, default=0) + 1):
            core.complete(block(f"{agent_id}.{ordinal}"))
            core.take_from_deque()
        for name in chain:
            core.commit(block(name))
        exported[agent_id] = export_chain(core, 1_200_000_000)
    return exported


def exports(chains: Chains) -> dict[int, Export]:
    return {agent_id: Export.model_validate(document) for agent_id, document in documents(chains).items()}


def write_run(run_dir: Path, chains: Chains, result: Mapping[str, Any] | None = None) -> Path:
    """Write a run directory with these chains. `result` replaces the run.json that `result_of` would return."""
    write_exports(run_dir / "agents", chains)
    (run_dir / "run.json").write_text(json.dumps({**result_of(list(chains)), **(result or {})}))
    return run_dir


def write_exports(directory: Path, chains: Chains) -> None:
    directory.mkdir(parents=True)
    for agent_id, document in documents(chains).items():
        (directory / f"{agent_id}.chain.json").write_text(json.dumps(document))


def result_of(agent_ids: Sequence[int]) -> dict[str, Any]:
    """Return the run.json of a run without any problem."""
    names = [
        "distributed",
        "idle ⇒ committed",
        "single copy",
        "genuine",
        "all committed everywhere",
        "one uniform chain",
    ]
    return {
        "schema": "ucp-run/1",
        "roster": list(agent_ids),
        "scenario": {
            "name": "15 % loss",
            "about": "The thesis's lossy test: every receiver drops 15 % of what it should hear.",
            "agents": list(agent_ids),
            "duration_s": 1200,
            "speedup": 20,
            "network": {"loss": 0.15, "receivers": {}},
            "timeline": [
                {"at_s": 300, "loss": None, "partition": [list(agent_ids[:1])], "heal": None},
                {"at_s": 600, "heal": True},
                {"at_s": 900, "loss": 0.5},
            ],
        },
        "seed": 1878470074,
        "backend": "process",
        "engine": "nftables",
        "versions": {"ucp-harness": "0.1.0", "python": "3.11.2", "kernel": "6.18"},
        "started_at": "2026-11-21T10:00:00Z",
        "wall_s": 61.2,
        "outcome": "completed",
        "outcome_detail": None,
        "characteristics": {
            str(number): {
                "name": name,
                "verdict": "holds" if number < 5 else "not applicable",
                "reason": "Looked at every export and every trace."
                if number < 5
                else "The network was not fully connected: 15 % loss.",
                "evidence": [],
            }
            for number, name in enumerate(names, start=1)
        },
        "figures": {
            "blocks": 41,
            "mutual_chain": 39,
            "distinct_chains": 2,
            "reconciles": 12,
            "copies_min": 4,
            "copies_mean": 4.9,
            "messages": 901,
            "bytes": 301442,
            "longest_vote_s": 12.5,
        },
        "survival": {
            "losses": [
                {
                    "at_s": 300.0,
                    "what": "crash",
                    "vehicles": [3],
                    "completed": 12,
                    "survived": 11,
                    "gone": 1,
                    "gone_at_end": 2,
                    "blocks": [
                        {
                            "block": "3.1",
                            "block_hash": "ab" * 32,
                            "agent_id": 3,
                            "holders": [],
                            "holders_at_end": [1, 2],
                        }
                    ],
                }
            ],
            "completed": 41,
            "gone": 2,
        },
        "vehicles": {
            str(agent_id): {"kind": "embedded", "mode": "GUIDED", "armed": True, "real_time_factor": 1.0}
            for agent_id in agent_ids
        },
        "agents": {str(agent_id): {"outcome": "exported", "detail": None, "idle": True} for agent_id in agent_ids},
        "faults": [
            {"at_s": 300.0, "what": "partition", "detail": "1, 2 | 3, 4, 5"},
            {"at_s": 600.0, "what": "heal", "detail": ""},
            {"at_s": 900.0, "what": "loss", "detail": "50 % for every receiver"},
        ],
    }

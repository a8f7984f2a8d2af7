"""What this machine can do for the lab, as facts; who prints them is not decided here.

Every fact comes from trying, in a lab of two vehicles that is gone a moment later: configuration files
and module lists say what might work, not what does.
"""

from __future__ import annotations

import asyncio
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from netem import _namespaces
from netem.lab import Lab, LabError


@dataclass(frozen=True)
class LabRequirement:
    """What a lab needs of a machine: whether it is there, what was seen, and what to do if not (else empty).

    Without what is `needed` there is no lab; of the engines any one will do.
    """

    name: str
    ok: bool
    detail: str
    way_out: str = ""
    needed: bool = True


def examine() -> list[LabRequirement]:
    """Everything that the lab needs, in the order in which it needs it. Takes about half a second."""
    ok, word = _namespaces.probe()
    requirements = [LabRequirement("namespaces", ok, word, "" if ok else _namespaces.way_out(word))]
    if not ok:
        return requirements
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "lab.log")
        tried = {name: _try(name, log) for name in ("netem", "nftables")}
        chosen = _try(None, log)
    broken = next((e for e in tried.values() if isinstance(e, LabError) and getattr(e, "stage", "") != "engine"), None)
    if broken is not None:
        reason = str(getattr(broken, "reason", broken))
        return [*requirements, LabRequirement("network", False, reason, getattr(broken, "way_out", ""))]
    requirements.append(LabRequirement("network", True, "bridge, veth pairs and a namespace for each vehicle"))
    for name, result in tried.items():
        if isinstance(result, str):
            requirements.append(LabRequirement(name, True, "works", needed=False))
        else:
            reason = str(getattr(result, "reason", result))
            requirements.append(LabRequirement(name, False, reason, getattr(result, "way_out", ""), needed=False))
    if isinstance(chosen, str):
        requirements.append(LabRequirement("engine", True, f"{chosen}, the first that works of netem and nftables"))
    else:
        requirements.append(LabRequirement("engine", False, str(chosen), getattr(chosen, "way_out", "")))
    return requirements


def _try(engine: Literal["netem", "nftables"] | None, log: Path) -> str | LabError:
    """The engine that a lab came up with, or why it did not."""

    async def attempt() -> str:
        async with await Lab.open((1, 2), engine=engine, log=log) as lab:
            return lab.engine

    try:
        return asyncio.run(attempt())
    except LabError as error:
        return error

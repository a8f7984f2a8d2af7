"""Find out whether this machine can run a virtual network.

The module opens a real lab of two vehicles, tests it, and removes it afterwards. Configuration files and lists of
kernel modules would not prove that a lab works.
"""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from netem import _namespaces
from netem.lab import Lab, LabError


@dataclass(frozen=True)
class LabRequirement:
    """A requirement of the virtual network, with an observation that shows whether this machine meets it, and a remedy.
    A machine that does not meet a `needed` requirement cannot open a lab. A single engine is not `needed`, because one
    of the two engines is enough.
    """

    name: str
    ok: bool
    detail: str
    way_out: str = ""
    needed: bool = True


def examine() -> list[LabRequirement]:
    """Return all requirements of a virtual network. In the list, each requirement follows the requirements on which it
    depends. The examination takes about half a second.
    """
    ok, message = _namespaces.probe()
    requirements = [LabRequirement("namespaces", ok, message, "" if ok else _namespaces.way_out(message))]
    if not ok:
        return requirements
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "lab.log")
        tried = {name: _try_engine(name, log) for name in ("netem", "nftables")}
        chosen = _try_engine(None, log)
        channel = [_shared_channel(log)] if isinstance(chosen, str) else []
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
    return [*requirements, *channel]


def _shared_channel(log: Path) -> LabRequirement:
    """Test whether a process can intercept broadcasts before the kernel delivers them. A shared radio channel in real
    time needs this ability.
    """

    async def attempt() -> str | None:
        async with await Lab.open((1, 2), log=log) as lab:
            argv = [sys.executable, "-P", "-m", "netem.relay", *map(str, lab.vehicles)]
            output = log.with_name("relay.log")
            relay = await lab.spawn(None, argv, cwd=log.parent, env=dict(os.environ), stdout=output, stderr=output)
            return None if await relay.wait() == 0 else output.read_text().strip()

    try:
        problem = asyncio.run(attempt())
    except LabError as error:
        problem = str(error)
    detail = problem or "works with processes and containers, in real time"
    way_out = "Play the channel in virtual time: --backend sim." if problem else ""
    return LabRequirement("shared channel", problem is None, detail, way_out, needed=False)


def _try_engine(engine: Literal["netem", "nftables"] | None, log: Path) -> str | LabError:
    """Return the engine that a test network uses, or the reason why the network could not be opened."""

    async def attempt() -> str:
        async with await Lab.open((1, 2), engine=engine, log=log) as lab:
            return lab.engine

    try:
        return asyncio.run(attempt())
    except LabError as error:
        return error

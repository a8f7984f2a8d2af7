"""Which engine a lab uses: the one asked for, or the first that this kernel can run."""

from __future__ import annotations

from collections.abc import Sequence

from netem._fabric import Fabric
from netem._nft import NftablesEngine
from netem.engine import Engine
from netem.errors import EngineError
from netem.tc import NetemEngine


def choose(preference: str | None, fabric: Fabric, needs: Sequence[str] = ()) -> tuple[Engine, str]:
    """The engine to use on this machine, installed, and why it is this one.

    Without a preference tc netem goes first, because it can do more; `needs` are what conditions will ask beyond
    loss and partition. An engine is tried by installing it: nothing else tells whether a kernel can. Raises
    EngineError with what each one lacks if none works.
    """
    engines: dict[str, type[Engine]] = {kind.name: kind for kind in (NetemEngine, NftablesEngine)}
    if preference is not None and preference not in engines:
        raise EngineError(f"engine: {preference!r} is not known; allowed is {' or '.join(engines)}")
    refused: list[str] = []
    for name, kind in engines.items():
        if preference not in (None, name):
            continue
        if needs and not kind.has_queues:
            refused.append(f"{name}: knows loss and partitions only")
            continue
        try:
            engine = kind(fabric)
        except EngineError as error:
            refused.append(f"{name}: {error}")
        else:
            reason = "asked for" if preference else "works on this kernel"
            return engine, "; ".join([*refused, f"{name}: {reason}"])
    raise EngineError("; ".join(refused))

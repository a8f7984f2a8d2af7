"""Choose the kernel mechanism (engine) that applies network conditions: the requested one, or the first that works."""

from __future__ import annotations

from collections.abc import Sequence

from netem._fabric import VirtualSwitch
from netem._nft import NftablesEngine
from netem.engine import Engine
from netem.errors import EngineError
from netem.tc import NetemEngine


def choose(preference: str | None, fabric: VirtualSwitch, needs: Sequence[str] = ()) -> tuple[Engine, str]:
    """Install the first suitable engine that works on this machine. Return the engine, and the reason for the choice.

    Without a preference, tc netem comes first, because it supports more. `needs` lists conditions other than loss and
    partition. An engine is tested by installing it, because nothing else shows whether the kernel supports it. Raises
    EngineError with the reason of each engine if none works.
    """
    engines: dict[str, type[Engine]] = {kind.name: kind for kind in (NetemEngine, NftablesEngine)}
    if preference is not None and preference not in engines:
        raise EngineError(f"engine: {preference!r} is not known; allowed is {' or '.join(engines)}")
    refused: list[str] = []
    for name, kind in engines.items():
        if preference not in (None, name):
            continue
        if needs and not kind.has_queues:
            refused.append(f"{name}: supports only loss and partitions")
            continue
        try:
            engine = kind(fabric)
        except EngineError as error:
            refused.append(f"{name}: {error}")
        else:
            reason = "asked for" if preference else "works on this kernel"
            return engine, "; ".join([*refused, f"{name}: {reason}"])
    raise EngineError("; ".join(refused))

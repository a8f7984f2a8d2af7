"""Choose the kernel mechanism (engine) that applies network conditions. If the caller requests an engine, only this
engine is tried. Otherwise the module chooses the first engine that works on this machine.
"""

from __future__ import annotations

from collections.abc import Sequence

from netem._fabric import VirtualSwitch
from netem._nft import NftablesEngine
from netem.engine import Engine
from netem.errors import EngineError
from netem.tc import NetemEngine


def choose(preference: str | None, fabric: VirtualSwitch, needs: Sequence[str] = ()) -> tuple[Engine, str]:
    """Install the first suitable engine that works on this machine. Return the engine, and a text with the reason for
    the choice.

    `preference` is the only engine to try. If it is None, the function tries tc netem first, because tc netem supports
    more conditions than nftables. `needs` lists the conditions other than loss and partition that the engine must
    support. The function installs each engine to test it, because no other test shows whether the kernel supports the
    engine. Raises EngineError if no engine works. Its message contains the reason for each engine.
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

"""Test that a long change is divided into several transactions for ordinary users, and that an incomplete change can be
undone.
"""

from typing import Any

import pytest

from netem import addresses
from netem._nft import NftablesEngine
from netem.conditions import LinkConditions, NetworkConditions
from netem.errors import EngineError

VEHICLES = range(1, 31)


class NarrowEngine(NftablesEngine):
    """An nftables engine that accepts few commands in a transaction. After `lasts` transactions, it fails."""

    def __init__(self) -> None:
        self._vehicles = tuple(VEHICLES)
        self._ports = [addresses.port(vehicle) for vehicle in VEHICLES]
        self._lossy = NetworkConditions()
        self.sent: list[int] = []
        self.lasts = 1000

    def _run(self, arguments: list[str], commands: list[dict[str, Any]] | None = None) -> str:
        count = len(commands or ())
        if count > 600:
            raise EngineError("nft refused: netlink: Error: Could not process rule: Message too long")
        if len(self.sent) == self.lasts:
            raise EngineError("nft refused: Error: no more memory")
        self.sent.append(count)
        return ""


def every_link() -> NetworkConditions:
    pairs = [(a, b) for a in VEHICLES for b in VEHICLES if a != b]
    return NetworkConditions(links={pair: LinkConditions(loss=(n + 1) / 1000) for n, pair in enumerate(pairs)})


def test_long_change_is_split_into_several_transactions() -> None:
    engine = NarrowEngine()
    engine.change(every_link())
    assert len(engine.sent) > 3
    assert sum(engine.sent) > 3000


def test_undo_of_a_partial_change_sets_all_losses_again() -> None:
    engine = NarrowEngine()
    engine.lasts = 2
    with pytest.raises(EngineError, match="no more memory"):
        engine.change(every_link())
    engine.sent.clear()
    engine.change(NetworkConditions())
    whole = sum(engine.sent)
    engine.sent.clear()
    engine.change(NetworkConditions())  # the conditions are already equal, so only the rules of the partition
    assert sum(engine.sent) < whole

"""The parts that local states are made of, each once: so that states are equal if their parts are the same."""

from hashlib import blake2b
from typing import Any

from harness.proof.model.flaws import Flaw
from harness.proof.model.snapshot import Snapshot, keyed

NAMES_OF_OTHERS = ("voters", "reconcile_responders")
"""Parts of the state that are sets of other agents."""


class Parts:
    """All parts of the states that were come upon."""

    def __init__(self) -> None:
        self._parts: dict[tuple[str, Any], Any] = {}
        self._numbers: dict[int, int] = {}
        """By `id`."""
        self._digests: dict[int, bytes] = {}
        """Of each part, by its `id`: the same on any machine."""
        self._hashes: dict[int, bytes] = {}

    def part(self, name: str, value: Any) -> Any:
        """The one part that stands for all that are equal."""
        key = name, keyed(value, self.name)
        part = self._parts.setdefault(key, value)
        if part is value:
            self._numbers.setdefault(id(part), len(self._numbers))
            self._digests[id(part)] = blake2b(repr(key[1]).encode(), digest_size=8).digest()
        return part

    def of(self, snapshot: Snapshot, like: Snapshot) -> Snapshot:
        """The same state of parts that there are; of `like` all are."""
        return {
            name: value if like.get(name, self) is value else self.part(name, value) for name, value in snapshot.items()
        }

    def key(self, agent_id: int, flaw: Flaw | None, snapshot: Snapshot) -> tuple[Any, ...]:
        """Equal for equal states, whose snapshots are of parts that there are."""
        numbers = self._numbers
        return (agent_id, flaw, *[numbers[id(part)] for part in snapshot.values()])

    def anonymous(self, agent_id: int, flaw: Flaw | None, snapshot: Snapshot) -> int:
        """Equal for states that differ only in who has voted and answered; the same number on any machine."""
        parts = [
            len(value) if name in NAMES_OF_OTHERS else self._digests[id(value)] for name, value in snapshot.items()
        ]
        return int.from_bytes(blake2b(repr((agent_id, flaw, parts)).encode(), digest_size=8).digest())

    def name(self, digest: bytes) -> int:
        """A number for a hash, the same on any machine."""
        name = int.from_bytes(digest[:8])
        assert self._hashes.setdefault(name, digest) == digest, "no two hashes that there are begin alike"
        return name

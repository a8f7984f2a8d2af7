"""What blocks are called, from whatever record says it: `<agent>.<ordinal>`, or the beginning of the hash."""

import re
from functools import cached_property

from harness.archive.block_names import name_blocks
from harness.field.replay.agent_record import Record

SHOWN = 12
_HASH = re.compile("[0-9a-f]{6,64}")
_NAME = re.compile(r"\d+\.\d+")


def is_block(words: str) -> bool:
    """Whether these may be the name of a block, or the beginning of its hash."""
    return bool(_NAME.fullmatch(words) or (_HASH.fullmatch(words) and not words.isdigit()))


class Names:
    """Names by hash and back. Exports say them, and traces where there are none."""

    def __init__(self, record: Record) -> None:
        self._record = record

    def of(self, block_hash: str) -> str:
        return self._names.get(block_hash) or block_hash[:SHOWN]

    def begins(self, words: str) -> str:
        """What the hash begins with of a block that is called so; the words themselves if nobody knows the name."""
        return self._hashes.get(words, words)

    @cached_property
    def _names(self) -> dict[str, str]:
        names: dict[str, str] = {}
        exports = self._record.beside.exports
        others = () if exports else self._record.beside.traces.values()
        for trace in (self._record.trace, *others):
            completed = dict.fromkeys(trace.completed())
            names.update((block, f"{trace.header.agent_id}.{count}") for count, block in enumerate(completed, 1))
        return names | name_blocks(exports)

    @cached_property
    def _hashes(self) -> dict[str, str]:
        return {name: block_hash for block_hash, name in self._names.items()}

"""Breakpoints in a record, and the source lines of handlers."""

import inspect
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from functools import cache
from itertools import takewhile
from pathlib import Path

from harness.checker.recorded_inputs import decoded
from harness.errors import FieldError
from harness.field.replay._agent_record import Entry
from harness.field.replay._player import Player
from harness.field.replay.replay_names import Names, is_block
from ucp.agent import HANDLERS
from ucp.messages import MalformedDatagramError, block_named
from ucp.trace import Commanded, Dropped, HandlerRun
from ucp.trigger import MessageTrigger

Place = Callable[[Entry], bool]
"""Whether an entry is there."""

_BY_ALGORITHM = {str(handler.algorithm): name for name, handler in HANDLERS.items()}


def place(words: str, names: Names) -> Place:
    """A line ("812"), a handler (its name, or "A13" by its Algorithm), a block ("4.11", or its hash's beginning).

    Raises FieldError if it is none of them.
    """
    words = words.strip()
    if words.isdigit():
        line = int(words)
        return lambda entry: entry.line == line
    handler = words if words in HANDLERS else _BY_ALGORITHM.get(words.upper().removeprefix("A"))
    if handler is not None:
        return lambda entry: isinstance(entry.what, HandlerRun) and entry.what.handler == handler
    if is_block(words.lower()):
        begins = names.begins(words.lower())
        return lambda entry: any(block_hash.startswith(begins) for block_hash in blocks_of(entry))
    near = get_close_matches(words, HANDLERS, n=3, cutoff=0.0)
    raise FieldError(
        f"{words[:60]!r} is not a breakpoint: use a line number, a handler (the nearest are {', '.join(near)}), an "
        "Algorithm such as A13, or a block such as 4.11"
    )


def next_place(player: Player, at: Place, backward: bool = False) -> int | None:
    """The position right after the next entry that is there, or the one before; None if there is none."""
    numbers = range(player.position - 2, -1, -1) if backward else range(player.position, len(player.entries))
    return next((number + 1 for number in numbers if at(player.entries[number])), None)


def blocks_of(entry: Entry) -> set[str]:
    """The hashes of the blocks that an entry is about: what it changes, is told of, and tells others."""
    what = entry.what
    if isinstance(what, Commanded):
        return set()
    hashes: set[str] = set()
    if isinstance(what, HandlerRun):
        hashes.update(block_hash for _, block_hash in what.changes)
        hashes.update(sent.block for sent in what.sent if sent.block)
    datagram = (
        what.datagram if isinstance(what, Dropped) else what.input if isinstance(what.trigger, MessageTrigger) else None
    )
    if datagram is not None:
        try:
            about = block_named(decoded(datagram).message)
        except MalformedDatagramError:
            about = None
        if about:
            hashes.add(about.hex())
    return hashes


@cache
def source_of(handler: str) -> str:
    """Such as "ucp/reconcile.py:187": its first statement, where a breakpoint stops each time that it runs.

    From the working directory, if the code is below that.
    """
    code = HANDLERS[handler].run.__code__
    defined = code.co_firstlineno + sum(1 for line in _decorators(handler))
    line = min(line for _, _, line in code.co_lines() if line is not None and line > defined)
    path, working = Path(code.co_filename), Path.cwd()
    return f"{path.relative_to(working) if path.is_relative_to(working) else path}:{line}"


def _decorators(handler: str) -> Iterator[str]:
    """The lines before its `def`, which run when the module is imported."""
    lines, _ = inspect.getsourcelines(HANDLERS[handler].run)
    return takewhile(lambda line: not line.startswith("def "), lines)

"""Parse breakpoints in a record, and find the source lines of handlers."""

import inspect
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from functools import cache
from itertools import takewhile
from pathlib import Path

from harness.checker.recorded_inputs import decoded
from harness.errors import FieldError
from harness.field.replay._agent_record import RecordEntry
from harness.field.replay._player import RecordPlayer
from harness.field.replay.replay_names import ReplayNames, is_block
from ucp.agent import HANDLERS
from ucp.messages import MalformedDatagramError, block_named
from ucp.trace import CommandEntry, DroppedDatagram, HandlerRun
from ucp.trigger import MessageTrigger

Breakpoint = Callable[[RecordEntry], bool]
"""A function that returns true for the entries at which the replay stops."""

_BY_ALGORITHM = {str(handler.algorithm): name for name, handler in HANDLERS.items()}


def parse_breakpoint(text: str, names: ReplayNames) -> Breakpoint:
    """Convert text to a breakpoint: a line ("812"), a handler (its name, or "A13"), or a block ("4.11").

    Raises FieldError for any other text.
    """
    text = text.strip()
    if text.isdigit():
        line = int(text)
        return lambda entry: entry.line == line
    handler = text if text in HANDLERS else _BY_ALGORITHM.get(text.upper().removeprefix("A"))
    if handler is not None:
        return lambda entry: isinstance(entry.content, HandlerRun) and entry.content.handler == handler
    if is_block(text.lower()):
        prefix = names.prefix_of(text.lower())
        return lambda entry: any(block_hash.startswith(prefix) for block_hash in blocks_of(entry))
    similar = get_close_matches(text, HANDLERS, n=3, cutoff=0.0)
    raise FieldError(
        f"{text[:60]!r} is not a breakpoint: use a line number, a handler (the nearest are {', '.join(similar)}), an "
        "Algorithm such as A13, or a block such as 4.11"
    )


def next_stop(player: RecordPlayer, stops_at: Breakpoint, backward: bool = False) -> int | None:
    """Return the position after the next entry that matches the breakpoint. If `backward` is true, search for the
    previous matching entry. Return None if no entry matches.
    """
    numbers = range(player.position - 2, -1, -1) if backward else range(player.position, len(player.entries))
    return next((number + 1 for number in numbers if stops_at(player.entries[number])), None)


def blocks_of(entry: RecordEntry) -> set[str]:
    """Return the hashes of the blocks that an entry changes, receives or sends."""
    content = entry.content
    if isinstance(content, CommandEntry):
        return set()
    hashes: set[str] = set()
    if isinstance(content, HandlerRun):
        hashes.update(block_hash for _, block_hash in content.changes)
        hashes.update(sent.block for sent in content.sent if sent.block)
    datagram = (
        content.datagram
        if isinstance(content, DroppedDatagram)
        else content.input
        if isinstance(content.trigger, MessageTrigger)
        else None
    )
    if datagram is not None:
        try:
            block_hash = block_named(decoded(datagram).message)
        except MalformedDatagramError:
            block_hash = None
        if block_hash:
            hashes.add(block_hash.hex())
    return hashes


@cache
def source_of(handler: str) -> str:
    """Return the place of a handler's first statement, such as "ucp/reconcile.py:187". A debugger with a breakpoint on
    this line stops when the handler runs. If the code is in the working directory, the path is relative to the working
    directory.
    """
    code = HANDLERS[handler].run.__code__
    defined = code.co_firstlineno + sum(1 for line in _decorators(handler))
    line = min(line for _, _, line in code.co_lines() if line is not None and line > defined)
    path, working = Path(code.co_filename), Path.cwd()
    return f"{path.relative_to(working) if path.is_relative_to(working) else path}:{line}"


def _decorators(handler: str) -> Iterator[str]:
    """Yield the source lines of the handler before `def`. A debugger does not stop in these lines, because they run
    only when the module is imported.
    """
    lines, _ = inspect.getsourcelines(HANDLERS[handler].run)
    return takewhile(lambda line: not line.startswith("def "), lines)

"""The interface of an adapter, and how an adapter is found.

An adapter reads records of another implementation, or of a recorder beside it, and says what they say, one observation
after another. It invents nothing: an agent that did not write down its handler runs has no trace, but what was heard
of it is still a capture.
"""

import importlib
import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from harness.errors import FieldError


@dataclass(frozen=True, slots=True)
class TraceLine:
    """A line of an agent's trace as the agent contract has it (`ucp-trace/2`): the header, a handler run, and so on.

    Of one agent they come in its order, the header first.
    """

    agent_id: int
    text: str | bytes
    where: int | None = None
    """Here and below: in which line, row or message of the source it stands, counting from 1."""


@dataclass(frozen=True, slots=True)
class Datagram:
    """A UDP datagram that agent `agent_id` sent, or received, at `time_ns`, nanoseconds since the Unix epoch."""

    agent_id: int
    time_ns: int
    sent: bool
    data: bytes
    where: int | None = None


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """An event that the agent was given to log at `time_ns`, nanoseconds since the Unix epoch (Section 3.1)."""

    agent_id: int
    time_ns: int
    event_id: int
    data: bytes
    where: int | None = None


@dataclass(frozen=True, slots=True)
class ChainExport:
    """A chain export, `ucp-chain-export/1`, as JSON."""

    text: str | bytes
    where: int | None = None


@dataclass(frozen=True, slots=True)
class Unusable:
    """A part of the source that says nothing usable: `why` ends a sentence, as "it has no time".

    With `of_a_trace` it may have been a line of a trace: that of `agent_id`, or if nobody knows, of any of them, is
    then not whole across this place.
    """

    why: str
    where: int | None = None
    of_a_trace: bool = False
    agent_id: int | None = None


BEGINNING_BYTES = 4096

Observation = TraceLine | Datagram | LoggedEvent | ChainExport | Unusable


class Adapter:
    """Subclass it, say what your format looks like, and read it.

    `counts` says what `where` counts: "line", "row", "message".
    """

    counts: ClassVar[str] = "line"

    def recognises(self, source: Path, beginning: bytes) -> bool:
        """Whether a file is of this format, by its name or by its first bytes. By default any is."""
        return True

    def part_of(self, source: Path) -> Path:
        """What a file is a part of, if one recording goes over several; else the file itself."""
        return source

    def observations(self, source: Path) -> Iterator[Observation]:
        """What a file says, in its order.

        What it raises ends the reading of this file, is told with the file's name, and what came before is used.
        """
        raise NotImplementedError


_HOW = "give MODULE:CLASS, such as my_logs:MyAdapter or path/to/my_logs.py:MyAdapter (docs/how-to/import-other-logs.md)"


def load_adapter(name: str) -> Adapter:
    """Raises FieldError if there is no such adapter, or it cannot be made."""
    module_name, separator, class_name = name.rpartition(":")
    if not separator or not module_name or not class_name.isidentifier():
        raise FieldError(f"{name!r} is not an adapter: {_HOW}")
    try:
        if module_name.endswith(".py"):
            path = Path(module_name)
            spec = importlib.util.spec_from_file_location(path.stem, path)
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(module_name)
        adapter = getattr(module, class_name)()
    except Exception as error:  # it is anybody's code
        raise FieldError(f"the adapter {name} cannot be loaded: {type(error).__name__}: {error}; {_HOW}") from None
    if not isinstance(adapter, Adapter):
        raise FieldError(
            f"{name} is not a subclass of harness.field.adapters.Adapter: see docs/how-to/import-other-logs.md"
        )
    return adapter

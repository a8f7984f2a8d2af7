"""Define an adapter, which reads another file format, and load adapters that users write.

An adapter reads the records of another implementation, or of a separate recorder, and yields their contents one
observation after another. It yields only recorded data. For example, if an agent did not record its handler runs, the
import creates no trace for this agent. If a separate recorder received the datagrams of the agent, the import still
creates a capture.
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
    """A line of an agent's trace in the format of the agent contract (`ucp-trace/2`), such as the header or a handler
    run. An adapter yields the lines of one agent in their original order, and the header first.
    """

    agent_id: int
    text: str | bytes
    where: int | None = None
    """Number of the line, row or message in the source file, counted from 1. The field `where` of the following classes
    has the same meaning.
    """


@dataclass(frozen=True, slots=True)
class Datagram:
    """A UDP datagram that agent `agent_id` sent or received at `time_ns`, in nanoseconds since the Unix epoch."""

    agent_id: int
    time_ns: int
    sent: bool
    data: bytes
    where: int | None = None


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """An event that the agent received for logging."""

    agent_id: int
    time_ns: int
    """The time of the event in nanoseconds since the Unix epoch (Section 3.1)."""
    event_id: int
    data: bytes
    where: int | None = None


@dataclass(frozen=True, slots=True)
class ChainExport:
    """A chain export in the format `ucp-chain-export/1`, as JSON."""

    text: str | bytes
    where: int | None = None


@dataclass(frozen=True, slots=True)
class Unusable:
    """A part of the source file that cannot be used."""

    why: str
    """The reason, as a text that completes a sentence, as in "it has no time"."""
    where: int | None = None
    of_a_trace: bool = False
    """True if the part may have been a line of a trace. The trace then has a gap at this place."""
    agent_id: int | None = None
    """The agent whose trace has the gap. If it is None, all traces have a gap."""


BEGINNING_BYTES = 4096

Observation = TraceLine | Datagram | LoggedEvent | ChainExport | Unusable


class Adapter:
    """The base class of adapters. A subclass recognises files of one format and reads them. `counts` names the unit in
    which `where` counts: "line", "row" or "message".
    """

    counts: ClassVar[str] = "line"

    def recognises(self, source: Path, beginning: bytes) -> bool:
        """Return true if a file has the format of this adapter. A subclass decides this by the file's name or first
        bytes. The default implementation accepts every file.
        """
        return True

    def part_of(self, source: Path) -> Path:
        """Return the path of the recording to which a file belongs. Several files, for example all files of a
        directory, may belong to one recording.

        By default, each file is a separate recording.
        """
        return source

    def observations(self, source: Path) -> Iterator[Observation]:
        """Yield the messages, events and trace lines in a file, in their order.

        If the method raises an exception, the rest of the file is not read. The import reports the exception with the
        name of the file, and uses the earlier observations.
        """
        raise NotImplementedError


_USAGE = (
    "give MODULE:CLASS, such as my_logs:MyAdapter or path/to/my_logs.py:MyAdapter (docs/how-to/import-other-logs.md)"
)


def load_adapter(name: str) -> Adapter:
    """Import a module and create the adapter `MODULE:CLASS`. Raises FieldError if that fails."""
    module_name, separator, class_name = name.rpartition(":")
    if not separator or not module_name or not class_name.isidentifier():
        raise FieldError(f"{name!r} is not an adapter: {_USAGE}")
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
    except Exception as error:  # A user's module may raise anything.
        raise FieldError(f"the adapter {name} cannot be loaded: {type(error).__name__}: {error}; {_USAGE}") from None
    if not isinstance(adapter, Adapter):
        raise FieldError(
            f"{name} is not a subclass of harness.field.adapters.Adapter: see docs/how-to/import-other-logs.md"
        )
    return adapter

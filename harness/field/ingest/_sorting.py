"""Recognises what each file is, by its content, and puts together what is of one flight."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.archive.bounded_file import BoundedFile
from harness.archive.exports import MAX_EXPORT_BYTES, Export, json_error, parse_export
from harness.archive.packets.pcap import MAGICS
from harness.errors import CaptureError, ExportError
from harness.field.ingest._file_owners import PUBLIC_SCHEMA, Glance, give_keys, glance, read_public_keys
from harness.field.ingest._file_search import files_of
from harness.field.ingest._flights import put_together
from harness.field.ingest._ingest import Homecoming, LeftOut, Remark
from harness.field.ingest._logged_events import read_logged
from harness.field.ingest._trace_incarnations import Life, read_lives
from harness.gc_pause import gc_paused
from ucp.events import LoggableEvent
from ucp.export import SCHEMA as EXPORT_SCHEMA

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.opening import Opener

MAX_DOCUMENTS = 1000
"""Exports in one file."""
ALIKE_TOLD = 3
"""Of files of one directory that are left out for the same reason."""
_BAGS = (b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd")
_ARCHIVES = (b"PK\x03\x04", b"7z\xbc\xaf", b"\xfd7zXZ", b"BZh", b"Rar!")
_BLANK = " \t\r\n\0\ufeff"


@gc_paused()
def sort_out(paths: Iterable[Path], opener: "Opener | None" = None) -> Homecoming:
    """What is in files and directories, of whatever name and in whatever state: sorted by flight.

    `opener` opens what is sealed in captures of a secured mission. Raises FieldError if a path does not exist. What
    cannot be used is told in `left_out`, and nothing else is raised.
    """
    left_out: list[LeftOut] = []
    sorter = Sorter(left_out, opener)
    for path in files_of(paths, left_out):
        sorter.take(path)
    return sorter.sorted_out()


class Sorter:
    """Takes files one after another, and what adapters make of others'."""

    def __init__(self, left_out: list[LeftOut], opener: "Opener | None" = None) -> None:
        self._opener = opener
        self.lives: list[Life] = []
        self.exports: list[tuple[Path, Export]] = []
        self.captures: list[Glance] = []
        self.logged: list[tuple[Path, int, LoggableEvent]] = []
        self._public_keys: list[tuple[Path, PublicKeys]] = []
        self._left_out = left_out

    def sorted_out(self) -> Homecoming:
        """What all of that makes."""
        remarks: list[Remark] = []
        flights = put_together(self.lives, self.exports, self.captures, self.logged, self._left_out, remarks)
        give_keys(flights, self._public_keys, self._left_out)
        return Homecoming(flights, [*_summed_up(self._left_out)], remarks)

    def take(self, path: Path) -> None:
        """Recognise a file, and read it."""
        try:
            with BoundedFile(path) as file:
                begins = file.peek(4096)[:4096]
            if begins.startswith(_BAGS):
                self._drop(path, "a ROS bag, or a compressed recording: read it with `ucp-harness import`")
            elif begins[:4] in MAGICS:
                seen = glance(path, self._left_out, self._opener)
                self.captures += [seen] if seen else []
            elif lives := read_lives(path, self._left_out):
                self.lives += lives
            elif logged := read_logged(path, self._left_out):
                self.logged += [(path, agent_id, event) for agent_id, event in logged]
            else:
                self._take_exports(path)
        except OSError as error:
            self._drop(path, f"it cannot be read: {error.strerror}")
        except CaptureError as error:
            self._drop(path, str(error).removeprefix(f"{path}: "))

    def _take_exports(self, path: Path) -> None:
        with BoundedFile(path, MAX_EXPORT_BYTES) as file:
            data = file.read()
            if file.problem:
                self._drop(path, f"it is incomplete: {file.problem}")
                return
        try:
            text = data.decode("utf-8").strip(_BLANK)
        except UnicodeDecodeError:
            text = ""
        if not text.startswith(("{", "[")):
            self._drop(path, _what_else(data))
            return
        if PUBLIC_SCHEMA in text:
            if (keys := read_public_keys(path, self._left_out)) is not None:
                self._public_keys.append((path, keys))
            return
        self.take_exports(path, text)

    def take_exports(self, path: Path, text: str, line: int | None = None, counts: str = "line") -> None:
        """The exports in a text; `line` is where it stands in the file, if it is not all of it."""
        try:
            for document in _documents(text.strip(_BLANK)):
                self.exports.append((path, parse_export(path, document)))
        except ExportError as error:
            self._drop(path, str(error).removeprefix(f"{path}: "), line, counts)
        except (ValueError, RecursionError) as error:
            what = "a chain export, but " if EXPORT_SCHEMA in text else ""
            self._drop(path, what + str(json_error(path, error)).removeprefix(f"{path}: "), line, counts)

    def _drop(self, path: Path, why: str, line: int | None = None, counts: str = "line") -> None:
        self._left_out.append(LeftOut(path, why, line, counts))


def _documents(text: str) -> Iterator[Any]:
    """JSON documents, one after another. Raises ValueError or RecursionError where it is none."""
    decoder, position = json.JSONDecoder(), 0
    for _ in range(MAX_DOCUMENTS):
        if position == len(text):
            return
        document, position = decoder.raw_decode(text, position)
        while position < len(text) and text[position] in _BLANK:
            position += 1
        yield document


def _what_else(data: bytes) -> str:
    if not data.strip(b"\0\r\n\t "):
        return "it is empty" if not data else "it holds only NUL bytes and blanks, as after a loss of power"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "it is UTF-16 text, as written by PowerShell: convert it with `iconv -f UTF-16 -t UTF-8`"
    if data.startswith(_ARCHIVES):
        return "it is an archive, or compressed with another program than gzip: unpack it first"
    printable = sum(byte >= 32 or byte in b"\t\r\n" for byte in data[:4096])
    content = "text" if printable > 0.9 * len(data[:4096]) else "binary data"
    return f"it is not a trace, chain export or capture: {content} without UCP records"


def _summed_up(left_out: list[LeftOut]) -> Iterator[LeftOut]:
    """Files of one directory that are left out for the same reason are told together if they are many."""
    alike: dict[tuple[Path, str], list[LeftOut]] = {}
    for each in left_out:
        alike.setdefault((each.path.parent, each.why) if each.line is None else (each.path, str(each.line)), []).append(
            each
        )
    for (_, why), group in alike.items():
        yield from group[:ALIKE_TOLD]
        if more := group[ALIKE_TOLD:]:
            names = ", ".join(each.path.name for each in more[:10]) + (", ..." if len(more) > 10 else "")
            yield LeftOut(
                more[0].path.parent, f"{len(more)} more files ({names}) are left out for the same reason: {why}"
            )

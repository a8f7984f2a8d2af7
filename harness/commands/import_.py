"""Implement `ucp-harness import`, which converts records of any program to the formats of the harness."""

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands.terminal import complain, print_lines
from harness.errors import FieldError
from harness.field.adapters import import_records
from harness.field.adapters.adapter import Adapter, load_adapter
from harness.field.adapters.csv_adapter import CsvAdapter
from harness.field.adapters.imported_records import ImportedFlight
from harness.field.adapters.rosbag_adapter import RosBag


class RecordFormat(Enum):
    """The file formats that the harness can import."""

    CSV = "csv"
    ROSBAG = "rosbag"


ADAPTERS: dict[RecordFormat, type[Adapter]] = {RecordFormat.CSV: CsvAdapter, RecordFormat.ROSBAG: RosBag}


def import_command(
    sources: Annotated[list[Path], typer.Argument(metavar="SOURCE", help="Files and directories of any kind.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Output directory; must be new or empty.")],
    adapter: Annotated[
        str | None,
        typer.Option(metavar="MODULE:CLASS", help="Adapter for a format of your own: my_logs:MyAdapter."),
    ] = None,
    format_: Annotated[
        RecordFormat | None, typer.Option("--format", help="Format of all sources; detected from each if not given.")
    ] = None,
) -> None:
    """Convert records of any kind into one directory.

    `check`, `replay`, `reconstruct` and `packets` read this directory. Everything usable is converted. The command and
    import.json name the sources that are left out.
    """
    if adapter is not None and format_ is not None:
        raise FieldError("--adapter and --format exclude each other: give one of them")
    own = [load_adapter(adapter)] if adapter else []
    adapters = [ADAPTERS[format_]()] if format_ else [*own, *(kind() for kind in ADAPTERS.values())]
    with Console(stderr=True).status("searching for files") as status:
        record = import_records(sources, adapters, out, status.update, by_content=format_ is None)
    for remark in (*record.left_out, *record.remarks):
        complain(remark.sentence)
    print_lines(_summary(flight, out) for flight in record.flights)


def _summary(flight: ImportedFlight, out: Path) -> str:
    agents = flight.agents.values()
    runs = sum(agent.handler_runs for agent in agents)
    kinds = {
        f"trace(s) with {runs} handler runs": sum(agent.trace is not None for agent in agents),
        "export(s)": sum(agent.export is not None for agent in agents),
        "capture(s)": sum(agent.capture is not None for agent in agents) + len(flight.more_captures),
        "flight log(s)": len({log for agent in agents for log in agent.flight_logs}),
        "list(s) of events": sum(agent.events is not None for agent in agents),
    }
    what = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
    return f"{out / flight.directory}: agents {', '.join(map(str, flight.agents)) or 'unknown'}: {what}"

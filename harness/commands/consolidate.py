"""Implement `ucp-harness consolidate`, which merges the chain exports of all vehicles into one record, sorted by
time.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from harness.archive.directory import claim
from harness.commands._shared_options import DepotKey, KeysOption, depot_of, refuse_existing, trusted_keys, write_new
from harness.commands.terminal import complain, print_lines
from harness.errors import ExportError
from harness.field.depot import record_outputs
from harness.field.depot.collected_exports import collect_exports
from harness.field.depot.consolidation import MergedRecord, consolidate
from harness.field.depot.record_lines import ReconcileResult
from harness.field.depot.record_outputs import in_words
from harness.report.logbook.positions import EventTrack, geojson, kml

if TYPE_CHECKING:
    from harness.field.depot.depot_reconcile import ReconciledExports

FINDING = 1
MAX_FINDINGS_SHOWN = 20
RECORD_SUFFIX = ".jsonl"
NO_MAP = "no vehicle logged a position, so there is no map: --kml and --geojson write no file"


def consolidate_command(
    paths: Annotated[list[Path], typer.Argument(help="Chain exports, and directories of them.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File for the record, NAME.jsonl; must be new.")
    ] = None,
    html_file: Annotated[
        Path | None, typer.Option("--html", help="Page with a map and a timeline; must be new.")
    ] = None,
    kml_file: Annotated[Path | None, typer.Option("--kml", help="Tracks for Google Earth; must be new.")] = None,
    geojson_file: Annotated[Path | None, typer.Option("--geojson", help="Tracks as GeoJSON; must be new.")] = None,
    csv_file: Annotated[
        Path | None, typer.Option("--csv", help="Table with a row for each event; must be new.")
    ] = None,
    final_reconcile: Annotated[
        bool,
        typer.Option(
            "--reconcile",
            help="Also reconcile the exports, and write NAME.reconciled/.",
        ),
    ] = False,
    depot_key: DepotKey = None,
    keys: KeysOption = None,
) -> None:
    """Merge the chains of all vehicles into one record.

    The record has each event once, the vehicles that hold it, and the events that were lost with a vehicle.

    Exit status 0: all was usable. 1: a file was left out, or an export was edited or damaged, or chains that were to be
    reconciled did not become one. 2: nothing was usable.
    """
    refuse_existing(path for path in (out, html_file, kml_file, geojson_file, csv_file) if path is not None)
    if out is not None and out.suffix != RECORD_SUFFIX:
        raise ExportError(
            f"{out}: the name of the record must end in {RECORD_SUFFIX}; other formats have their own options, such as "
            "--kml"
        )
    if final_reconcile and out is None:
        raise ExportError("--reconcile writes the exports next to the record: name the record with -o NAME.jsonl")
    record = consolidate(collect_exports(paths, trusted_keys(keys)), depot_of(depot_key))
    reconciliation = _reconcile(record, out.with_suffix(".reconciled")) if final_reconcile and out is not None else None
    reconciled = reconciliation.line if reconciliation else None
    print_lines(in_words(record, reconciled, opened=depot_key is not None))
    if record.collected.unproven is not None:
        print_lines([record.collected.unproven])
    print_lines(_write_outputs(record, reconciled, out, kml_file, geojson_file, csv_file))
    if html_file is not None:
        from harness.field.depot.page import draw

        write_new(html_file, [draw(record, reconciliation)])
        print_lines([str(html_file)])
    findings = [*record.collected.problems, *record.collected.left_out]
    for sentence in findings[:MAX_FINDINGS_SHOWN]:
        complain(sentence)
    if len(findings) > MAX_FINDINGS_SHOWN:
        complain(f"and {len(findings) - MAX_FINDINGS_SHOWN} more findings; the header of the record lists all of them")
    if findings or (reconciled is not None and not reconciled.uniform):
        raise typer.Exit(FINDING)


def _reconcile(record: MergedRecord, directory: Path) -> "ReconciledExports":
    from harness.field.depot.depot_reconcile import reconcile, write  # slow: it imports the simulation

    claim(directory)
    with Console(stderr=True).status("reconciling", spinner="line") as status:
        reconciliation = reconcile(record, status.update)
    write(reconciliation, directory)
    return reconciliation


def _write_outputs(
    record: MergedRecord,
    reconciled: ReconcileResult | None,
    out: Path | None,
    kml_file: Path | None,
    geojson_file: Path | None,
    csv_file: Path | None,
) -> Iterator[str]:
    """Write the requested output files. Yield a line of text with the path of each file."""
    if out is not None:
        write_new(out, record_outputs.lines(record, reconciled))
        yield str(out)
    if reconciled is not None and out is not None:
        yield f"{out.with_suffix('.reconciled')}: the exports of {len(reconciled.vehicles)} vehicles, reconciled"
    if csv_file is not None:
        write_new(csv_file, [record_outputs.table(record)])
        yield str(csv_file)
    if kml_file is not None or geojson_file is not None:
        yield from _maps(_tracks(record), {kml_file: kml, geojson_file: _geojson})


def _tracks(record: MergedRecord) -> list[EventTrack]:
    """Return the tracks of the vehicles: the positions that vehicles logged as events, and the flight logs of the other
    vehicles.
    """
    logged = record_outputs.tracks(record)
    known = {track.agent_id for track in logged}
    flown = record_outputs.flown_tracks(record_outputs.flight_logs(record))
    return [*logged, *(track for track in flown if track.agent_id not in known)]


def _maps(tracks: list[EventTrack], forms: dict[Path | None, Callable[[Iterable[EventTrack]], str]]) -> Iterator[str]:
    if not tracks:
        yield NO_MAP
        return
    for path, form in forms.items():
        if path is not None:
            write_new(path, [form(tracks)])
            yield f"{path}: {sum(len(track.fixes) for track in tracks)} positions of {len(tracks)} vehicles"


def _geojson(tracks: Iterable[EventTrack]) -> str:
    return json.dumps(geojson(tracks), ensure_ascii=False) + "\n"

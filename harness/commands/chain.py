"""Implement `ucp-harness chain`, which prints the chains of a run, or writes the positions in them as a map."""

import json
from pathlib import Path
from typing import Annotated

import typer

from harness.archive.archive import RunArchive
from harness.commands._shared_options import DepotKey, depot_of, write_new
from harness.commands.terminal import complain, print_lines
from harness.errors import WRONG_REQUEST, ExportError
from harness.report import logbook
from harness.report.logbook.logbook_text import document, lines
from harness.report.logbook.positions import EventTrack, geojson, kml, recorded_tracks, tracks


def chain_command(
    paths: Annotated[list[Path], typer.Argument(help="Run directory, or chain exports.")],
    agent: Annotated[int | None, typer.Option(help="Only the chain in this agent's export.")] = None,
    decode: Annotated[bool, typer.Option("--decode", help="Print each event in words.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the chains as JSON.")] = False,
    geojson_file: Annotated[
        Path | None, typer.Option("--geojson", help="Write positions as GeoJSON instead; must be new.")
    ] = None,
    kml_file: Annotated[
        Path | None, typer.Option("--kml", help="Write positions for Google Earth instead; must be new.")
    ] = None,
    depot_key: DepotKey = None,
) -> None:
    """Print each agent's chain, or map the vehicles' positions."""
    archive = RunArchive(*paths)
    whole = logbook.read(archive, depot_of(depot_key))
    shown = whole if agent is None else whole.only(agent)
    if geojson_file is not None or kml_file is not None:
        record = archive.origin
        recorded = recorded_tracks(record, archive.tracks(record.known_agents))
        map_tracks = tracks(shown) or [track for track in recorded if agent in (None, track.agent_id)]
        _write_maps(map_tracks, shown, geojson_file, kml_file)
    elif as_json:
        print_lines([json.dumps(document(shown, decode), indent=1)])
    else:
        print_lines(lines(shown, decode))
    for sentence in (*shown.absent.values(), *shown.errors):
        complain(sentence)
    if shown.errors or not shown.exports:
        raise typer.Exit(WRONG_REQUEST)


def _write_maps(
    map_tracks: list[EventTrack], shown: logbook.Logbook, geojson_file: Path | None, kml_file: Path | None
) -> None:
    """Write the paths that the vehicles took to the requested map files. Raises ExportError if there are no paths."""
    if not map_tracks:
        why = "the events are not of vehicles, and the run has no recorded tracks"
        if shown.telemetry:
            why = (
                "the positions are sealed: give the depot's key with --depot-key"
                if shown.event_data.is_closed
                else "no vehicle logged a position"
            )
        raise ExportError(f"these chains hold no positions, so there is no map: {why}")
    if geojson_file is not None:
        write_new(geojson_file, [json.dumps(geojson(map_tracks), ensure_ascii=False) + "\n"])
    if kml_file is not None:
        write_new(kml_file, [kml(map_tracks)])
    written = " and ".join(str(path) for path in (geojson_file, kml_file) if path is not None)
    positions = sum(len(track.fixes) for track in map_tracks)
    print_lines([f"{positions} positions of {len(map_tracks)} vehicles: {written}"])

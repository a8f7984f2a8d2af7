"""Implement `ucp-harness reconstruct`, which writes a scenario that reproduces a recorded flight."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands._shared_options import BundleOption, DepotKey, KeysOption, depot_of, opener_of, trusted_keys
from harness.commands.terminal import complain, output, print_json
from harness.errors import VIOLATED, RunDirectoryError
from harness.field.ingest import ingest_files
from harness.field.reconstruct import reconstruct, write


def reconstruct_command(
    paths: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Records of a flight: directories, files, run directories.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Scenario file; must be new.")],
    bundle: BundleOption = None,
    depot_key: DepotKey = None,
    keys: KeysOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Make a scenario that reproduces a recorded flight.

    The scenario plays in virtual time. Exit status 0: the scenario reproduces all chains. 1: it does not, and the
    command prints the first difference, or a signature is wrong. 2: no record is usable.
    """
    if out.exists():
        raise RunDirectoryError(f"{out} exists: choose another --out; existing files are not overwritten")
    with Console(stderr=True).status("reading the records") as status:
        opener, depot = opener_of(bundle), depot_of(depot_key)
        result = ingest_files(paths, opener)
        flight = result.largest()
        name = f"{paths[0].resolve().name} flown again"[:200]
        reconstruction = reconstruct(flight, name, status.update, opener=opener, depot=depot, keys=trusted_keys(keys))
    left_out = [*result.sentences()]
    write(reconstruction, out, paths, left_out)
    for sentence in (*left_out, *reconstruction.wrong_signatures):
        complain(sentence)
    if as_json:
        print_json({"scenario": str(out), **reconstruction.to_json()})
    else:
        console = output(highlight=False)
        for sentence in (reconstruction.sentence, *reconstruction.problems[1:], *reconstruction.remarks, str(out)):
            console.print(sentence, soft_wrap=True, markup=False)
    if reconstruction.problems or reconstruction.wrong_signatures:
        raise typer.Exit(VIOLATED)

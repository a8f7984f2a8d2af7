"""Implement `ucp-harness calibrate`, which fits the radio parameters of a scenario to the record of a real flight."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands._shared_options import refuse_existing, write_new
from harness.commands.terminal import complain, output, print_json
from harness.field.calibrate.calibration import calibrate
from harness.field.calibrate.page import draw
from harness.scenario import Preset
from harness.scenario.scenario_file import to_yaml


def calibrate_command(
    paths: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Records and flight logs of a flight: directories and files.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Scenario file; must be new.")],
    html: Annotated[Path | None, typer.Option("--html", help="Also write a page with plots; must be new.")] = None,
    channel: Annotated[
        Preset | None, typer.Option("--channel", help="Write a shared channel with this preset in place of a radio.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Fit the radio of a scenario to the records of a flight.

    Traces or captures show which messages arrived. Flight logs (.bin, .tlog), a run's tracks or logged positions show
    the distances. Exit status 0: a scenario is written. 2: nothing is usable.
    """
    refuse_existing([path for path in (out, html) if path is not None])
    with Console(stderr=True).status("reading the records"):
        calibration = calibrate(paths)
    name = f"{paths[0].resolve().name} calibrated"[:200]
    sentences = [*calibration.sentences()]
    comment = [
        f"Made by `ucp-harness calibrate` from {', '.join(map(str, paths))}.",
        *(f"- {each}" for each in sentences),
    ]
    write_new(out, [to_yaml(calibration.scenario(name, channel), comment)])
    if html is not None:
        write_new(html, [draw(calibration, name)])
    for sentence in calibration.problems:
        complain(sentence)
    if as_json:
        print_json({"scenario": str(out), **calibration.to_json(), "network": calibration.network(channel)})
        return
    console = output(highlight=False)
    for sentence in (*sentences, str(out)):
        console.print(sentence, soft_wrap=True, markup=False)

"""`ucp-harness scale`: how the protocol grows."""

from pathlib import Path
from typing import Annotated

import typer

from harness.archive.directory import claim, default_path
from harness.commands.terminal import end_sweep
from harness.run.parallel import cores
from harness.sweep import scale
from harness.sweep.scale import model, outputs, table


def scale_command(
    agents: Annotated[str, typer.Option(help="Numbers of agents, with commas.")] = model.AGENTS,
    minutes: Annotated[str, typer.Option(help="Mission lengths in minutes, with commas.")] = model.MINUTES,
    loss: Annotated[str, typer.Option(help="Loss at each receiver, a probability; several with commas.")] = (
        model.LOSS
    ),
    seeds: Annotated[int, typer.Option(help="Runs of each size.")] = model.SEEDS,
    settle: Annotated[float, typer.Option(help="Minutes to finish after the mission.")] = model.SETTLE_MINUTES,
    agent_command: Annotated[
        str | None, typer.Option(help="Measure this agent, driven by lines (COMMAND --virtual).")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Directory of the results; must be new or empty.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="scale.json on standard output, no table.")] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time; as many as cores if not given.")
    ] = None,
) -> None:
    """Fit how messages, bytes and time grow with agents and blocks."""
    request = scale.read_request(agents, minutes, loss, seeds, settle, agent_command)
    directory = (out or default_path("scale")).absolute()
    claim(directory)
    finished = scale.run_scale(request, jobs or cores(), shown=True)
    outputs.write(finished, directory)
    end_sweep(finished.record, None if as_json else table.render(finished.record), directory / "report.html")

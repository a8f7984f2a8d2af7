"""Implement `ucp-harness coverage` and `validate`, which compare runs with all possible states and with the TLA+
specification.
"""

import dataclasses
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer

from harness import checker
from harness.archive.archive import RunArchive
from harness.commands.terminal import StatusLine, complain, output, print_json, print_lines
from harness.errors import WRONG_REQUEST, RunDirectoryError
from harness.proof import Bounds, coverage, specification
from harness.proof.bounds import EVENT_FILLS_BLOCK
from harness.proof.coverage import ReachedStates
from harness.scenario import load_scenario
from ucp.settings import Settings

BLOCK_SIZE_SETTINGS = {*EVENT_FILLS_BLOCK, "max_event_bytes"}
"""Settings that affect only the size of blocks. These settings have no effect on `prove`, because blocks have no size
in `prove`.
"""


def coverage_command(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run directories, or directories of traces.")],
    agents: Annotated[int, typer.Option(help="Number of agents in the state space to compare with.")] = 3,
    blocks: Annotated[int, typer.Option(help="Number of blocks that these agents complete in all.")] = 3,
    network: Annotated[str, typer.Option(help="Network of these agents: lossless, lossy or any.")] = "lossy",
    faults: Annotated[str, typer.Option(help="Faults: reboot, death and duplicate, separated by commas.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Report the share of all local states that runs reached.

    All local states are those that `prove` finds within the given bounds.
    """
    reached = ReachedStates()
    settings: dict[str, Any] | None = None
    for path in runs:
        evidence = checker.gather(RunArchive(path))
        if not evidence.traces:
            raise RunDirectoryError(
                f"{path} has no traces, and the coverage is computed from traces: name a run directory with traces"
            )
        for trace in evidence.traces.values():
            relevant = _relevant_settings(trace.header.settings)
            if settings is not None and relevant != settings:
                raise RunDirectoryError(
                    f"{path} was played with other settings than the runs before it: measure the "
                    "coverage of runs with equal settings"
                )
            settings = relevant
        reached.add(coverage.reached_in(evidence))
    chosen = tuple(name for name in faults.split(",") if name)
    bounds = Bounds(agents, blocks, network, chosen, settings=settings or {})  # type: ignore[arg-type]  # it is checked
    state_space = coverage.existing(bounds)
    if as_json:
        print_json({"runs": len(runs), **coverage.to_json(reached, state_space)})
    else:
        console = output()
        for line in coverage.in_words(reached, state_space):
            console.print(line, highlight=False, soft_wrap=True, markup=False)
    if not reached.steps:
        complain("no trace has a step that could be followed, so nothing was measured")
        raise typer.Exit(WRONG_REQUEST)


def _relevant_settings(settings: Mapping[str, Any]) -> dict[str, object]:
    """Return the settings that differ from their defaults and affect the local states of an agent."""
    default = dataclasses.asdict(Settings())
    return {
        name: value
        for name, value in settings.items()
        if name in default and name not in BLOCK_SIZE_SETTINGS and value != default[name]
    }


def validate_command(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RUN...", help="Run directories, directories of traces, or traces."),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Scenario (name or YAML file) to play and validate as well.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds for --scenario.")] = 1000,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Compare recorded runs with the TLA+ specification.

    Exit status 0: each step is as specified. 1: an agent deviates. 2: a record is not readable. 3: TLC is not
    installed. 130: interrupted; the result covers the runs before.
    """
    if not runs and scenario is None:
        raise typer.BadParameter("validate needs recorded runs, or a --scenario to play")
    sources = specification.recorded(runs or ())
    count = len(runs or ())
    if scenario is not None:
        sources = chain(sources, specification.simulated(load_scenario(scenario), range(seeds)))
        count += seeds
    with StatusLine() as status_line:
        validation = specification.validate(
            sources,
            watch=lambda done: status_line.show(
                f"{done.runs:,} of {count:,} runs, {done.steps:,} handler runs checked"
            ),
        )
    if as_json:
        print_json(validation.to_json())
    else:
        print_lines(validation.in_words())
    if validation.interrupted:
        complain("interrupted")
    raise typer.Exit(validation.exit_status)

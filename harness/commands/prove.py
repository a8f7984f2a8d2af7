"""Implement `ucp-harness prove`, which explores all states that a swarm can reach within bounds."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
import yaml

from harness import proof as prove
from harness.commands._shared_options import RARE
from harness.commands.terminal import StatusLine, complain, output, print_json
from harness.errors import INTERRUPTED
from harness.proof import Bounds, BoundsError, ExplorationProgress, Limits, original, specification
from harness.run.parallel import cores, sigterm_as_ctrl_c

GIGABYTE = 1e9
TIMERS = ("duration", "any")
CLOCKS = ("agreed", "any")
ZONES = ("equal", "contained")
LIMITS, WRONG = "Limits", "Wrong or captured agents"


def prove_command(
    agents: Annotated[int, typer.Option(help="Number of agents.")] = 2,
    blocks: Annotated[int, typer.Option(help="Number of blocks that the agents complete in all.")] = 3,
    network: Annotated[
        str, typer.Option(help="Network: lossless, lossy, or any (late, repeated, in any order).")
    ] = "lossy",
    faults: Annotated[str, typer.Option(help="Faults: reboot, death and duplicate, separated by commas.")] = "",
    timers: Annotated[
        str,
        typer.Option(rich_help_panel=RARE, help="Order in which timers expire: by duration, or any."),
    ] = "duration",
    coincidences: Annotated[
        int | None,
        typer.Option(rich_help_panel=RARE, help="Maximum number of chance coincidences; no limit if not given."),
    ] = None,
    clocks: Annotated[
        str,
        typer.Option(rich_help_panel=RARE, help="Age order of blocks: equal for all agents (agreed), or any."),
    ] = "agreed",
    zones: Annotated[
        str,
        typer.Option(rich_help_panel=RARE, help="Zones that count as one: equal, or contained in another."),
    ] = "equal",
    losses: Annotated[
        int | None,
        typer.Option(rich_help_panel=RARE, help="Maximum number of lost messages; no limit if not given."),
    ] = None,
    no_crossing: Annotated[
        bool,
        typer.Option(
            "--no-crossing",
            rich_help_panel=RARE,
            help="Deliver all messages of one action before the next action.",
        ),
    ] = False,
    settings: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="Protocol setting of all agents; may be repeated.")
    ] = None,
    stagger: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TIMER=SECONDS",
            rich_help_panel=RARE,
            help="Extra timer seconds of each next agent; may be repeated.",
        ),
    ] = None,
    quirk: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", rich_help_panel=WRONG, help="Deliberate mistake of all agents; may be repeated."
        ),
    ] = None,
    captured: Annotated[
        int | None,
        typer.Option(metavar="ID", rich_help_panel=WRONG, help="Agent whose keys an attacker holds."),
    ] = None,
    lies: Annotated[
        int | None,
        typer.Option(rich_help_panel=WRONG, help="Number of messages that the attacker sends; 1 if not given."),
    ] = None,
    whole: Annotated[bool, typer.Option("--whole", rich_help_panel=RARE, help="Disable state reduction.")] = False,
    steps: Annotated[
        bool,
        typer.Option(
            "--steps",
            rich_help_panel=WRONG,
            help="Also compare each step of the agents with the independent reference.",
        ),
    ] = False,
    second_opinion: Annotated[
        bool,
        typer.Option(
            "--second-opinion", rich_help_panel=RARE, help="Compare the states with those of the TLA+ specification."
        ),
    ] = False,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="ORIGINAL",
            help="Original to compare with: commit, checkout or `installed`.",
        ),
    ] = None,
    cores_: Annotated[
        int | None,
        typer.Option("--cores", rich_help_panel=LIMITS, help="Number of processes; one for each core if not given."),
    ] = None,
    memory: Annotated[
        float, typer.Option(rich_help_panel=LIMITS, help="Maximum memory of all processes, in gigabytes.")
    ] = 4.0,
    for_s: Annotated[
        float | None,
        typer.Option("--for", rich_help_panel=LIMITS, help="Maximum run time in seconds; no limit if not given."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File for the scenario that shows a violation; must be new.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Explore all states that a small swarm can reach within bounds.

    Exit status 0: all properties hold. 1: a property is violated, and a scenario shows it. 4: a limit of time or memory
    was reached before all states were explored. 130: interrupted. With --against, 1 only for findings that the original
    lacks.
    """
    if timers not in TIMERS:
        raise BoundsError(f"--timers must be one of {', '.join(TIMERS)}, not {timers!r}")
    if clocks not in CLOCKS:
        raise BoundsError(f"--clocks must be one of {', '.join(CLOCKS)}, not {clocks!r}")
    if zones not in ZONES:
        raise BoundsError(f"--zones must be one of {', '.join(ZONES)}, not {zones!r}")
    quirks = _pairs("--quirk", quirk)
    if lies is not None and (captured is None or network == "any"):
        raise BoundsError(
            "--lies needs --captured, and does not apply to --network any, where the number of lies is "
            "unlimited: leave it out"
        )
    bounds = Bounds(
        agents,
        blocks,
        network,  # type: ignore[arg-type]  # it is checked
        tuple(name for name in faults.split(",") if name),
        timers == "any",
        coincidences,
        _pairs("--settings", settings),
        quirks,
        reduced=not whole,
        steps=steps,
        stagger=_pairs("--stagger", stagger),  # type: ignore[arg-type]  # it is checked
        captured=captured,
        lies=1 if lies is None else lies,
        clocks_any=clocks == "any",
        losses=losses,
        crossing=not no_crossing,
        zones_contained=zones == "contained",
    )
    if bounds.reduced and (reason := bounds.why_not_reduced()) is not None:
        complain(f"state reduction is disabled: {reason}")
        bounds = replace(bounds, reduced=False)
    limits = Limits(memory * GIGABYTE, float("inf") if for_s is None else for_s, cores() if cores_ is None else cores_)
    if second_opinion:
        with StatusLine() as status_line, sigterm_as_ctrl_c():
            opinion = specification.second_opinion(
                bounds, limits, watch=lambda progress: status_line.show(_progress_text(progress))
            )
        _print_result(opinion.to_json(), opinion.in_words(), as_json)
        raise typer.Exit(opinion.exit_status)
    if against is not None:
        _compare(against, bounds, limits, out, as_json)
    with StatusLine() as status_line, sigterm_as_ctrl_c():
        proof = prove.prove(bounds, limits, out, watch=lambda progress: status_line.show(_progress_text(progress)))
    _print_result(proof.to_json(), prove.in_words(proof), as_json)
    if proof.exit_status == INTERRUPTED:
        complain("interrupted")
    raise typer.Exit(proof.exit_status)


def _compare(against: str, bounds: Bounds, limits: Limits, out: Path | None, as_json: bool) -> NoReturn:
    """Run the same proof for the original agent core, and compare both results."""
    with original.code_of(against) as code, StatusLine() as status_line, sigterm_as_ctrl_c():
        if bounds.reduced and original.is_edited(code):
            complain(f"state reduction is disabled: it assumes the released core, and {against} has another one")
            bounds = replace(bounds, reduced=False)
        proof = prove.prove(bounds, limits, out, watch=lambda progress: status_line.show(_progress_text(progress)))
        comparison = original.ProofComparison(proof, original.prove_original(against, code, bounds, limits))
    _print_result(comparison.to_json(), comparison.in_words(), as_json)
    raise typer.Exit(comparison.exit_status)


def _print_result(document: dict[str, Any], lines: Iterable[str], as_json: bool) -> None:
    if as_json:
        print_json(document)
        return
    console = output()
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def _pairs(option: str, texts: list[str] | None) -> dict[str, Any]:
    pairs = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals:
            raise BoundsError(f"{option} {text!r} is not of the form NAME=VALUE")
        try:
            pairs[name] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise BoundsError(f"{option} {name} cannot be {value!r}") from None
    return pairs


def _progress_text(progress: ExplorationProgress) -> str:
    if progress.asked is not None:
        return f"{progress.states:,} states, all explored; now checking: {progress.asked}"
    frontier = progress.states - progress.looked_at
    rate = progress.transitions / max(progress.seconds, 0.001)
    known = f"{progress.states:,} states, {frontier:,} of them not explored"
    return f"{known}, {progress.depth} instants, {rate:,.0f} transitions/s"

"""`ucp-harness prove`: look at everything that can happen within bounds."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from rich.console import Console

from harness import proof as prove
from harness.commands.terminal import Watcher, complain, print_json
from harness.errors import INTERRUPTED
from harness.proof import Bounds, BoundsError, Limits, Progress, specification
from harness.run.parallel import cores, terminated_is_interrupted

GIGABYTE = 1e9
TIMERS = ("duration", "any")
CLOCKS = ("agreed", "any")


def prove_command(
    agents: Annotated[int, typer.Option(help="How many agents there are.")] = 2,
    blocks: Annotated[int, typer.Option(help="How many blocks they complete in all, anybody at any moment.")] = 3,
    network: Annotated[
        str, typer.Option(help="lossless; lossy: anybody may lose any message; any: late, twice, in any order.")
    ] = "lossy",
    faults: Annotated[
        str, typer.Option(help="Of reboot, death (each once, at any moment) and duplicate, with commas between.")
    ] = "",
    timers: Annotated[
        str,
        typer.Option(help="When timers end: by duration; any: in whatever order."),
    ] = "duration",
    coincidences: Annotated[
        int | None,
        typer.Option(help="How many moments, at most, are the same by chance; without it any number."),
    ] = None,
    clocks: Annotated[
        str,
        typer.Option(help="Which of two blocks is the older: agreed, the one completed first; any: either, each time."),
    ] = "agreed",
    losses: Annotated[
        int | None,
        typer.Option(help="How often, at most, an agent loses a message; without it any number."),
    ] = None,
    no_crossing: Annotated[
        bool, typer.Option("--no-crossing", help="All that comes of one act is heard before anybody else acts.")
    ] = False,
    settings: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="A setting of all agents; may be repeated.")
    ] = None,
    stagger: Annotated[
        list[str] | None,
        typer.Option(metavar="TIMER=SECONDS", help="How much longer each next agent's timer runs; may be repeated."),
    ] = None,
    quirk: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="A mistake that all agents make; may be repeated.")
    ] = None,
    captured: Annotated[
        int | None,
        typer.Option(metavar="ID", help="Somebody has this agent's keys, and says anything with them."),
    ] = None,
    lies: Annotated[
        int | None, typer.Option(help="How many messages that are, each heard by any; any number with --network any.")
    ] = None,
    whole: Annotated[
        bool, typer.Option("--whole", help="Take no two states for one, though they behave alike.")
    ] = False,
    steps: Annotated[
        bool, typer.Option("--steps", help="Hold each step of wrong agents (--quirk) against that of a right one, too.")
    ] = False,
    second_opinion: Annotated[
        bool,
        typer.Option("--second-opinion", help="Look at the specification in TLA+, too: are its states the same?"),
    ] = False,
    cores_: Annotated[
        int | None, typer.Option("--cores", help="How many processes look at states; as many as there are cores.")
    ] = None,
    memory: Annotated[float, typer.Option(help="Gigabytes of all processes at which to give up.")] = 4.0,
    for_s: Annotated[float | None, typer.Option("--for", help="Seconds after which to give up.")] = None,
    out: Annotated[Path | None, typer.Option(help="File of the scenario that shows what was found; new.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Look at every state that the agents can come to within bounds: is any wrong, or without a way out?

    Exit status 0: everything holds. 1: something does not, and a scenario shows it. 4: a bound was reached before
    everything had been looked at. 130: interrupted.
    """
    if timers not in TIMERS:
        raise BoundsError(f"--timers must be one of {', '.join(TIMERS)}, not {timers!r}")
    if clocks not in CLOCKS:
        raise BoundsError(f"--clocks must be one of {', '.join(CLOCKS)}, not {clocks!r}")
    quirks = _pairs("--quirk", quirk)
    if lies is not None and (captured is None or network == "any"):
        raise BoundsError("--lies is for --captured, and not for --network any, where any number is heard")
    bounds = Bounds(
        agents,
        blocks,
        network,  # type: ignore[arg-type]  # it is checked
        tuple(name for name in faults.split(",") if name),
        timers == "any",
        coincidences,
        _pairs("--settings", settings),
        quirks,
        reduced=not whole and not quirks,
        steps=steps,
        stagger=_pairs("--stagger", stagger),  # type: ignore[arg-type]  # it is checked
        captured=captured,
        lies=1 if lies is None else lies,
        clocks_any=clocks == "any",
        losses=losses,
        crossing=not no_crossing,
    )
    limits = Limits(memory * GIGABYTE, float("inf") if for_s is None else for_s, cores() if cores_ is None else cores_)
    if second_opinion:
        with Watcher() as watcher, terminated_is_interrupted():
            opinion = specification.second_opinion(
                bounds, limits, watch=lambda progress: watcher.show(_how_far(progress))
            )
        _say(opinion.to_json(), opinion.in_words(), as_json)
        raise typer.Exit(opinion.exit_status)
    with Watcher() as watcher, terminated_is_interrupted():
        proof = prove.prove(bounds, limits, out, watch=lambda progress: watcher.show(_how_far(progress)))
    _say(proof.to_json(), prove.in_words(proof), as_json)
    if proof.exit_status == INTERRUPTED:
        complain("interrupted")
    raise typer.Exit(proof.exit_status)


def _say(document: dict[str, Any], lines: Iterable[str], as_json: bool) -> None:
    if as_json:
        print_json(document)
        return
    console = Console()
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def _pairs(option: str, texts: list[str] | None) -> dict[str, Any]:
    pairs = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals:
            raise BoundsError(f"{option} {text!r} should be a name, =, and a value")
        try:
            pairs[name] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise BoundsError(f"{option} {name} cannot be {value!r}") from None
    return pairs


def _how_far(progress: Progress) -> str:
    if progress.asked is not None:
        return f"{progress.states:,} states, all looked at; now asked: {progress.asked}"
    frontier = progress.states - progress.looked_at
    rate = progress.transitions / max(progress.seconds, 0.001)
    known = f"{progress.states:,} states, {frontier:,} of them not looked at"
    return f"{known}, {progress.depth} instants, {rate:,.0f} transitions/s"

"""Implement `ucp-harness conformance`, which tests whether a single agent follows Algorithms 1 to 20."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.text import Text

from harness.commands._shared_options import RARE, refuse_existing, write_new
from harness.commands.terminal import complain, output, print_json
from harness.conformance.conformance_page import read_agents, to_html
from harness.conformance.conformance_run import ConformanceRequest, conform, remote_agents
from harness.conformance.results import TITLES, ConformanceResults
from harness.conformance.results_table import progress, render, summary, to_junit
from harness.conformance.vectors import generate, to_lines
from harness.errors import HarnessError, MachineError
from harness.play.agent_control import resolve_command
from harness.play.remote.agent_pool import AgentPool
from harness.play.remote.join import join_command
from harness.play.remote.secret_file import read_secret
from harness.run.parallel import sigterm_as_ctrl_c
from sitl.address import ListenAddress
from sitl.vehicle import VehicleError
from ucp.agent import HANDLERS


class ConformanceRequestError(HarnessError):
    """An error: the options of `ucp-harness conformance` contradict each other, or name no Algorithm."""


def conformance_command(
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="-- COMMAND...", help="Command that starts the agent; see ucp/contract/CONTRACT.md."),
    ] = None,
    only: Annotated[
        str | None, typer.Option(metavar="ALG", help="Test one Algorithm, by number (13) or by handler name.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the results as JUnit XML; must be new.")
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Directory for vectors and captures of failures; must be new."),
    ] = None,
    virtual: Annotated[bool, typer.Option("--virtual", help="Test in virtual time, with COMMAND --virtual.")] = False,
    matrix: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Test all agents of a YAML file of names and commands."),
    ] = None,
    page: Annotated[Path, typer.Option(metavar="FILE", help="Page for the results of --matrix; must be new.")] = Path(
        "conformance.html"
    ),
    small: Annotated[
        bool, typer.Option("--small", help="Apply the profile for small machines of the agent contract.")
    ] = False,
    listen: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS:PORT", help="Test an agent that joins from another computer, not COMMAND."),
    ] = None,
    secret_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File with the secret that the other computer has, too.")
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the generated vectors, and test nothing; must be new.",
            rich_help_panel=RARE,
        ),
    ] = None,
) -> None:
    """Test one agent alone with thousands of generated cases.

    The harness plays the agent's peers over UDP.

    Exit status 0: every case passed. 1: a case failed. 3: no case failed, but a case was not tried. With --matrix, the
    highest status of all agents counts; 2: an agent could not be tested.
    """
    refuse_existing(path for path in (junit, keep, write) if path is not None)
    if only is not None and only not in HANDLERS and only not in map(str, TITLES):
        raise ConformanceRequestError(
            f"--only {only[:60]}: no such Algorithm; give a number from 1 to 20 or the name of a handler"
        )
    if write is not None:
        write_new(write, to_lines(generate(only)))
        return
    if matrix is not None:
        if command:
            raise ConformanceRequestError("--matrix and the command of one agent exclude each other: give one of them")
        if as_json or junit is not None or keep is not None or listen is not None or small:
            raise ConformanceRequestError(
                "--matrix excludes --json, --junit, --keep, --listen and --small: leave them out"
            )
        refuse_existing([page])
        raise typer.Exit(_test_all(read_agents(matrix), only, page, virtual=virtual))
    if small and virtual:
        raise ConformanceRequestError("--small excludes --virtual, because the profile is about programs over UDP")
    remote = _remote_agents(listen, secret_file, command, virtual=virtual)
    if not command and remote is None:
        raise ConformanceRequestError(
            "the command of the agent is missing: for example, `ucp-harness conformance -- "
            "python3 -m ucp.node` tests the harness's own agent"
        )
    console = output(stderr=as_json, highlight=False)
    if remote is not None:
        complain(f"on the other computer, type: {join_command(remote.listen, remote.agent_id)}")
    resolved = tuple(resolve_command(command, "the agent")) if command else ()
    place = keep or Path("conformance-failures")
    with TemporaryDirectory(prefix="ucp-conformance-") as scratch, sigterm_as_ctrl_c(), progress() as show:
        request = ConformanceRequest(resolved, only, _unused_path(place), virtual, remote=remote, small=small)
        results = conform(request, Path(scratch), show)
    if junit is not None:
        write_new(junit, [to_junit(results)])
    if as_json:
        print_json(results.to_json())
    else:
        console.print(render(results), soft_wrap=True)
    if results.interrupted:
        complain(f"interrupted; results so far: {summary(results)}")
    raise typer.Exit(results.exit_status)


def _remote_agents(
    listen: str | None, secret_file: Path | None, command: list[str] | None, *, virtual: bool
) -> AgentPool | None:
    """Return the agents on another computer. Return None if the agent runs here."""
    if (listen is None) != (secret_file is None):
        raise ConformanceRequestError("--listen and --secret-file need each other: give both of them")
    if listen is None or secret_file is None:
        return None
    if command or virtual:
        raise ConformanceRequestError(
            "--listen excludes --virtual and a command: the other computer has the command, after `join ... --`"
        )
    try:
        address = str(ListenAddress.parse(listen))
    except VehicleError:
        raise ConformanceRequestError(
            f"--listen: {listen[:60]!r} is not ADDRESS:PORT, for example 192.168.7.1:14700"
        ) from None
    return remote_agents(address, read_secret(secret_file))


def _test_all(agents: Mapping[str, Sequence[str]], only: str | None, page: Path, *, virtual: bool) -> int:
    """Test each agent, write the page with all results, and return the highest of their exit statuses."""
    console = output(highlight=False)
    outcomes: dict[str, ConformanceResults | str] = {}
    for name, command in agents.items():
        with TemporaryDirectory(prefix="ucp-conformance-") as scratch, sigterm_as_ctrl_c(), progress() as show:
            try:
                request = ConformanceRequest(tuple(resolve_command(list(command), "the agent")), only, None, virtual)
                outcomes[name] = conform(request, Path(scratch), show)
            except MachineError:
                raise
            except HarnessError as error:
                outcomes[name] = str(error)
        outcome = outcomes[name]
        console.print(Text(f"{name}: {outcome if isinstance(outcome, str) else summary(outcome)}"), soft_wrap=True)
        if isinstance(outcome, ConformanceResults) and outcome.interrupted:
            break
    write_new(page, [to_html(outcomes)])
    console.print(Text(str(page)), soft_wrap=True)
    statuses = [outcome.exit_status if isinstance(outcome, ConformanceResults) else 2 for outcome in outcomes.values()]
    return max(statuses, default=0)


def _unused_path(place: Path) -> Path:
    """Return `place` if no file exists there. Otherwise append the first free number to it, so that earlier results are
    not overwritten.
    """
    number, fresh = 1, place
    while fresh.exists():
        number += 1
        fresh = place.with_name(f"{place.name}-{number}")
    return fresh

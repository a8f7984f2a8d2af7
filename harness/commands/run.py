"""Implement `ucp-harness run`, which runs a scenario and judges the run."""

import secrets
from contextlib import nullcontext
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from rich.console import Console

from harness.archive.directory import default_path
from harness.archive.recorded_scenario import load_recorded_scenario
from harness.backend_names import BackendName
from harness.commands._shared_options import RARE, complete_scenario
from harness.commands.report import PORT, show_address
from harness.commands.terminal import complain, output, show_programs, show_result, show_rogue, show_survival
from harness.errors import HarnessError, ScenarioError
from harness.play import progress
from harness.play.backends import BACKENDS
from harness.play.interventions import Interventions
from harness.play.machine.uml_kernel import OUT, UmlKernel, run_inside
from harness.play.trace_space import space_sentence
from harness.report.facts import cut_off, gaps
from harness.report.live.server_process import live_page
from harness.run.run import Run, run
from harness.scenario import Scenario
from harness.scenario.agent_options import quirks_in_words
from harness.scenario.agent_programs import Programs, command_keys, programs_of
from harness.scenario.load import explain


class VehicleKind(StrEnum):
    ardupilot = "ardupilot"
    embedded = "embedded"
    none = "none"


def run_command(
    scenario: Annotated[
        Path,
        typer.Argument(
            metavar="SCENARIO|RUN",
            help="Scenario (name or YAML file), or run directory to play again.",
            autocompletion=complete_scenario,
        ),
    ],
    seed: Annotated[
        int | None, typer.Option(min=0, help="Random seed; the seed of RUN or a new one if not given.")
    ] = None,
    speedup: Annotated[float | None, typer.Option(help="Mission seconds per second of wall time.")] = None,
    agents: Annotated[
        list[str] | None,
        typer.Option(
            "--ucp-agent",
            metavar="[ID=]COMMAND",
            help="Other agent for all vehicles or, with ID=, for one; repeatable.",
        ),
    ] = None,
    vehicles: Annotated[VehicleKind | None, typer.Option(help="Kind of vehicles, instead of the scenario's.")] = None,
    backend: Annotated[
        BackendName, typer.Option(help="Processes in private networks, containers, or virtual time.")
    ] = "process",
    gcs: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", rich_help_panel=RARE, help="UDP address of a ground station for all vehicles."
        ),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS:PORT", rich_help_panel=RARE, help="Address at which to wait for agents on other computers."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="TCP://HOST:PORT",
            rich_help_panel=RARE,
            help="Dask scheduler whose workers play agents and vehicles.",
        ),
    ] = None,
    capture: Annotated[
        bool, typer.Option("--capture", help="Record each vehicle's frames in capture/ID.pcapng.")
    ] = False,
    secured: Annotated[
        bool,
        typer.Option("--secured", rich_help_panel=RARE, help="Secure the mission with fresh keys if it has none."),
    ] = False,
    image_from_host: Annotated[
        bool,
        typer.Option(
            "--image-from-host",
            rich_help_panel=RARE,
            help="Run containers from this machine's files, and build no image.",
        ),
    ] = False,
    by_hand: Annotated[
        bool,
        typer.Option("--by-hand", help="Take events from `ucp-harness tell`; virtual time starts paused."),
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show the run in the browser, live and then as a film.")
    ] = False,
    watch_port: Annotated[int, PORT] = 0,
    out: Annotated[Path | None, typer.Option(help="Run directory; must be new or empty.")] = None,
    emit_compose: Annotated[
        Path | None,
        typer.Option(metavar="FILE", rich_help_panel=RARE, help="Write a docker compose file, and run nothing."),
    ] = None,
    kernel: Annotated[
        UmlKernel,
        typer.Option(rich_help_panel=RARE, help="This machine's kernel, or User Mode Linux, which has netem."),
    ] = UmlKernel.host,
) -> None:
    """Play a scenario, judge it, and write a report.

    Exit status 0: no verdict is bad. 1: a verdict is bad, or an agent failed. 2: the scenario is wrong, or a scripted
    fate matched no message. 3: this machine cannot play it, or an agent does not support it. 4: the only bad verdict is
    `not finished`. 130: interrupted.
    """
    if scheduler is not None and listen is not None:
        raise ScenarioError("--scheduler places all agents, so none joins at --listen: leave out one of them")
    console = output()
    loaded, recorded_seed = load_recorded_scenario(scenario)
    programs = programs_of(agents or ())
    request = _with_options(loaded, speedup, vehicles, gcs, listen, capture, image_from_host, programs)
    if secured:
        request = request.secured()
    directory = (out or default_path(request.name)).absolute()
    seed = recorded_seed if seed is None else seed
    chosen_seed = secrets.randbelow(2**32) if seed is None else seed
    if emit_compose is not None:
        _emit_compose(console, request, chosen_seed, emit_compose)
        return
    if kernel is UmlKernel.uml:
        if scheduler is not None:
            raise ScenarioError(
                "--scheduler does not work with --kernel uml, because the workers do not reach a run "
                "inside User Mode Linux: leave out one of them"
            )
        if by_hand:
            raise ScenarioError(
                "--by-hand does not work with --kernel uml, because commands do not reach a run "
                "inside User Mode Linux: leave out one of them"
            )
        if watch:
            raise ScenarioError(
                "--watch does not work with --kernel uml, because the page cannot connect to a run "
                "inside User Mode Linux: leave out one of them"
            )
        if why := BACKENDS[backend].not_in_uml:
            raise HarnessError(why)
        if request.gcs:
            raise ScenarioError(
                "--gcs does not work with --kernel uml, because datagrams do not reach a ground "
                "station outside User Mode Linux: leave out one of them"
            )
        if request.remote is not None:
            raise ScenarioError(
                "`remote` does not work with --kernel uml, because other computers do not reach a run "
                "inside User Mode Linux: leave out one of them"
            )
        options = {"--seed": chosen_seed, "--speedup": speedup, "--vehicles": vehicles}
        given = [f"{option}={value}" for option, value in options.items() if value is not None]
        given += [f"{OUT}{directory.resolve()}"]
        given += ["--capture"] if capture else []
        given += ["--secured"] if secured else []
        given += [f"--ucp-agent={agent}" for agent in agents or ()]
        console.print("Booting User Mode Linux.", style="dim")
        raise typer.Exit(run_inside(["run", *given, "--", str(scenario)]))
    console.print(f"{request.name}, seed {chosen_seed}, into {directory}", highlight=False, soft_wrap=True)
    if wrong := ", ".join(quirks_in_words(request.quirks)):
        console.print(f"deliberate mistakes: {wrong}", style="dim", highlight=False)
    if request.remote is not None:
        from harness.play.remote.join import join_commands

        for command in join_commands(request):
            console.print(f"on its computer: {command}", highlight=False, soft_wrap=True)
    if remark := BACKENDS[backend].remark(request):
        console.print(remark, style="dim")
    virtual = BACKENDS[backend].virtual_time
    remark, warning = space_sentence(request, directory, all_delivered=watch or not virtual)
    if remark:
        console.print(remark, style="dim", highlight=False, soft_wrap=True)
    if warning:
        complain(warning)
    takes_events = watch or by_hand
    interventions = None
    if takes_events:
        interventions = Interventions(request, virtual_time=virtual, factor=request.speedup, paused=by_hand)
    with (
        live_page(directory, watch_port, interventions)
        if watch and interventions is not None
        else nullcontext() as page
    ):
        if page is not None:
            show_address(console, page.address)
        shown = progress.for_console(console)
        watched = shown if page is None else page.tee(shown)
        try:
            delivers_all = watch and virtual  # the page shows the receivers of each message
            finished = run(
                request,
                chosen_seed,
                directory,
                watched,
                backend,
                delivers_all=delivers_all,
                interventions=interventions,
                scheduler=scheduler,
            )
        finally:
            shown.close()
        _show(console, finished)
        if page is not None:
            is_watched = page.run_is_over()
            if page.problem is not None:
                complain(page.problem)
            if is_watched and finished.played.outcome != "interrupted":
                console.print("The page stays open until you close it or press Ctrl-C.", style="dim")
                page.wait()
    raise typer.Exit(finished.exit_status)


def _show(console: Console, finished: Run) -> None:
    if finished.played.outcome != "not supported":
        show_result(console, finished.result, finished.record)
        show_survival(console, finished.survival)
        show_rogue(console, finished.rogue)
    show_programs(console, finished.record)
    _show_end(console, finished)


def _emit_compose(console: Console, scenario: Scenario, seed: int, file: Path) -> None:
    from harness.play.containers.compose import write_compose
    from harness.play.process.vehicle_kinds import choose_vehicles
    from sitl.system_ids import system_ids

    beside = write_compose(scenario, seed, choose_vehicles(scenario), system_ids(scenario.roster), file)
    console.print(f"{file} and {beside}: docker compose -f {file} up", highlight=False, soft_wrap=True)


def _with_options(
    scenario: Scenario,
    speedup: float | None,
    vehicles: VehicleKind | None,
    gcs: str | None,
    listen: str | None,
    capture: bool,
    image_from_host: bool,
    programs: Programs,
) -> Scenario:
    """Return the scenario with the options of the command line. An option replaces the key of the scenario."""
    document: dict[str, Any] = scenario.model_dump() | command_keys(scenario, programs)
    if speedup is not None:
        if not 0 < speedup <= 1000:
            raise typer.BadParameter(f"{speedup:g} is not a speedup: use a number above 0 and at most 1000")
        document["speedup"] = speedup
    if vehicles is not None:
        document["vehicles"]["kind"] = vehicles.value
    if gcs is not None:
        document["gcs"] = gcs
    if listen is not None:
        if document["remote"] is None:
            raise ScenarioError("--listen is for agents on other computers: name them in the scenario, in `remote`")
        document["remote"]["listen"] = listen
    document["capture"] |= capture
    if image_from_host:
        document["docker"]["image_from_host"] = True
    try:
        return Scenario.model_validate(document)
    except ValidationError as error:
        raise ScenarioError(explain(error, Scenario)) from None


def _show_end(console: Console, finished: Run) -> None:
    if finished.played.outcome == "not supported":
        complain(f"{finished.played.outcome_detail}; the run has no verdict")
    elif finished.played.outcome != "completed":
        complain(f"{finished.played.outcome_detail}; the chains and traces that were written are checked")
    for error in finished.result.errors:
        complain(error)
    for sentence in finished.played.unmatched_fates:
        complain(f"{sentence}, so this run differs from its script")
    for agent_id, agent in finished.record.agents.items():
        if agent.left_behind:
            names = ", ".join(agent.left_behind)
            complain(
                f"agent {agent_id} ended and left processes running ({names}), which the harness ended: an agent must "
                "end all processes that it starts"
            )
    if lacks := gaps(finished.played.capture or {}):
        complain(f"{lacks}: choose a smaller --speedup")
    for sentence in cut_off(finished.record):
        complain(sentence)
    station = finished.record.ground_station
    if station is not None and station.dropped:
        complain(
            f"{station.dropped} datagrams of the ground station at {station.address} were dropped, because they were "
            "damaged or arrived too fast"
        )
    slow = [
        f"{vehicle} ({record['real_time_factor']:.2f})"
        for vehicle, record in finished.played.vehicles.items()
        if (record.get("real_time_factor") or 1.0) < 0.95
    ]
    if slow:
        complain(f"vehicles {', '.join(slow)} did not keep up with the clock: choose a smaller --speedup")
    channel = finished.record.channel
    if channel is not None and channel.lateness is not None and not channel.lateness.tolerable:
        complain(
            f"this machine was too slow for the channel. {channel.lateness.in_words()}: choose a smaller --speedup"
        )
    if late_answers := finished.record.late_answers():
        complain(f"{late_answers}: choose a smaller --speedup, fewer agents, or a greater `processing_s`")
    late = finished.timer_lag
    if late is not None and not late.tolerable:
        lateness = f"one in twenty vote timers expired {late.late_s:.1f} or more mission seconds late"
        complain(f"this machine was too slow: {lateness} (set to {late.asked_s:g} s): choose a smaller --speedup")
    early = [agent for agent, each in finished.record.agents.items() if each.trace_problem]
    if early:
        why = finished.record.agents[early[0]].trace_problem
        complain(
            f"the traces of agents {', '.join(early)} end early ({why}), so some checks could not judge the run: free "
            "disk space or raise `trace_quota_mb`"
        )
    wall = f"{finished.wall_s:.0f}" if finished.wall_s >= 10 else f"{finished.wall_s:.1f}"
    console.print(f"{wall} s; report: {finished.report}", highlight=False, soft_wrap=True)

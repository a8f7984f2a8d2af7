"""Implement `ucp-harness join`, which lets an agent on this computer take part in a run on another one."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from harness.commands.terminal import output
from harness.play.agent_control import resolve_command
from harness.play.remote.join import JoinRequest, join
from harness.play.remote.secret_file import create_secret, read_secret
from sitl.address import ListenAddress
from sitl.vehicle import VehicleError
from ucp.block import MAX_AGENT_ID


def join_command(
    address: Annotated[
        str | None, typer.Argument(metavar="HOST:PORT", help="Address at which the harness listens.")
    ] = None,
    command: Annotated[
        list[str] | None, typer.Argument(metavar="COMMAND...", help="Command of the agent, after --.")
    ] = None,
    agent_id: Annotated[
        int | None, typer.Option("--as", min=1, max=MAX_AGENT_ID, help="ID of the agent in the mission.")
    ] = None,
    secret_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File with the secret of the harness.")
    ] = None,
    service: Annotated[bool, typer.Option("--service", help="Join every run, until Ctrl-C.")] = False,
    new_secret: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Make a file with a new secret, and end.")
    ] = None,
) -> None:
    """Let an agent on this computer take part in a run elsewhere.

    The scenario names the agent in `remote`. The agent runs here, in a private network with the addresses of its
    vehicle. The scenario defines when the agent starts, pauses, dies and reboots. If the connection is lost, the agent
    continues for up to 60 s while the command connects again.
    """
    if new_secret is not None:
        create_secret(new_secret)
        output().print(f"{new_secret}: copy it to the other computer, and keep its mode 600", highlight=False)
        return
    if address is None or agent_id is None or secret_file is None or not command:
        raise typer.BadParameter("HOST:PORT, --as, --secret-file and, after --, the command of the agent are needed")
    try:
        harness = ListenAddress.parse(address)
    except VehicleError:
        raise typer.BadParameter(f"{address!r} is not HOST:PORT, for example 192.168.7.1:14700") from None
    console: Console = output()
    resolved = resolve_command(command, "the command of the agent")
    request = JoinRequest(harness.host, harness.port, agent_id, read_secret(secret_file), resolved, service)
    join(request, lambda sentence: console.print(sentence, highlight=False, soft_wrap=True))

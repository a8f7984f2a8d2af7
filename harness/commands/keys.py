"""`ucp-harness keys`: the keys of a mission, made and kept at home, and what each vehicle is given of them."""

from pathlib import Path
from typing import Annotated

import typer

from harness.commands._shared_options import refuse_existing, roster_of
from harness.commands.terminal import complain, print_json, print_lines
from harness.errors import MachineError
from harness.scenario.load import parse

try:
    from harness.play.keyring.inspection import in_words, inspect
    from harness.play.keyring.key_directory import Home, KeysError, write_revocation
    from ucp.secure.bundle import DEFAULT_EPOCH_S, MAX_EPOCH_S
except ModuleNotFoundError:
    raise MachineError("keys take a further package: `pip install ucp-harness[secure]`") from None

SEVERAL_MISSIONS = 1

app = typer.Typer(
    no_args_is_help=True, help="Make the keys of a secure mission, hand out what each vehicle gets, and take it back."
)

HomeArgument = Annotated[Path, typer.Argument(metavar="HOME", help="The directory of the mission's keys.")]


@app.command("new")
def new_command(
    home: HomeArgument,
    agents: Annotated[str, typer.Option(help="The roster: a number of agents, or their IDs, as 10,28,32.")],
    sealed: Annotated[
        bool, typer.Option("--sealed/--open", help="Whether event data is sealed to a depot key, made here, too.")
    ] = True,
    epoch_s: Annotated[
        float, typer.Option(min=1, max=MAX_EPOCH_S, help="Mission seconds after which vehicles forget a group secret.")
    ] = DEFAULT_EPOCH_S,
) -> None:
    """Make the keys of a mission: the authority's, the depot's, and each vehicle's, in a new directory.

    Nobody else can enter it. Of all that is in it, public.json alone is not secret.
    """
    agent_ids = parse({"name": "keys", "agents": roster_of(agents)}).roster
    made = Home.new(home, agent_ids, seals=sealed, epoch_s=epoch_s)
    print_lines(map(in_words, inspect(made.directory)))


@app.command("bundle")
def bundle_command(
    home: HomeArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the bundles, one file for each vehicle.")],
    agents: Annotated[
        list[int] | None, typer.Option("--agent", help="Of this vehicle alone; may be repeated. Without it, of all.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace bundles that are there.")] = False,
) -> None:
    """Write what each vehicle is given: its own key, the group secret, and all public keys.

    A vehicle that is revoked is given nothing.
    """
    print_lines(map(str, Home(home).write_bundles(out, agents, overwrite=overwrite)))


@app.command("inspect")
def inspect_command(
    paths: Annotated[list[Path], typer.Argument(help="Files of keys, or directories of them.")],
    as_json: Annotated[bool, typer.Option("--json", help="All that is not secret as JSON on standard output.")] = False,
) -> None:
    """Say what files of keys are, and of which mission, without a secret.

    Exit status 0: all are sound, and of one mission. 1: they are of several. 2: one cannot be used.
    """
    told = [facts for path in paths for facts in inspect(path)]
    if as_json:
        print_json(told)
    else:
        print_lines(map(in_words, told))
    missions = {facts["mission"] for facts in told}
    if len(missions) > 1:
        complain(f"these are keys of {len(missions)} missions, whose vehicles do not hear each other")
        raise typer.Exit(SEVERAL_MISSIONS)


@app.command("revoke")
def revoke_command(
    home: HomeArgument,
    agents: Annotated[list[int], typer.Argument(help="IDs of the vehicles whose keys are taken back.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Write the message there, too, for whoever sends it; must be new."),
    ] = None,
) -> None:
    """Take keys back: write the authority's message, which says all vehicles that are revoked so far.

    It is no secret. Whichever vehicle is given it tells all others that it hears.
    """
    if out is not None:
        refuse_existing([out])
    kept = Home(home)
    revocation = kept.revoke(agents)
    if out is not None:
        try:
            write_revocation(out, revocation, kept.public())
        except OSError as error:
            raise KeysError(f"{out} cannot be made: {error.strerror}; choose another file") from None
    print_lines([in_words(facts) for facts in inspect(kept.directory / "revocation.json")])

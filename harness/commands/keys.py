"""Implement `ucp-harness keys`, which creates the keys of a mission, writes key files for vehicles, and excludes
vehicles.

All secret keys stay in the key directory at the ground. A vehicle gets only its bundle.
"""

from pathlib import Path
from typing import Annotated

import typer

from harness.commands._shared_options import refuse_existing, roster_of
from harness.commands.terminal import complain, print_json, print_lines
from harness.errors import extra
from harness.scenario.load import parse

with extra("secure", "the command keys"):
    from harness.play.keyring.inspection import in_words, inspect
    from harness.play.keyring.key_directory import KeyDirectory, KeysError, write_revocation
    from ucp.secure.bundle import DEFAULT_EPOCH_S, MAX_EPOCH_S

SEVERAL_MISSIONS = 1

app = typer.Typer(no_args_is_help=True, help="Make, distribute, inspect and revoke keys of a secure mission.")

HomeArgument = Annotated[Path, typer.Argument(metavar="HOME", help="Directory of the mission's keys.")]


@app.command("new")
def new_command(
    home: HomeArgument,
    agents: Annotated[str, typer.Option(help="Number of agents, or their IDs, such as 10,28,32.")],
    sealed: Annotated[
        bool, typer.Option("--sealed/--open", help="Encrypt event data for a new depot key, or leave it readable.")
    ] = True,
    epoch_s: Annotated[
        float, typer.Option(min=1, max=MAX_EPOCH_S, help="Mission seconds after which vehicles forget a group secret.")
    ] = DEFAULT_EPOCH_S,
) -> None:
    """Make the keys of a mission in a new directory.

    The command makes keys of the authority, the depot and each vehicle. Other users cannot read the directory. All
    files in it are secret except public.json.
    """
    agent_ids = parse({"name": "keys", "agents": roster_of(agents)}).roster
    made = KeyDirectory.new(home, agent_ids, seals=sealed, epoch_s=epoch_s)
    print_lines(map(in_words, inspect(made.directory)))


@app.command("bundle")
def bundle_command(
    home: HomeArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the bundles, one file for each vehicle.")],
    agents: Annotated[list[int] | None, typer.Option("--agent", help="Only this vehicle; may be repeated.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing bundles.")] = False,
) -> None:
    """Write the key bundle of each vehicle.

    A bundle holds the vehicle's own key, the group secret, and all public keys. A revoked vehicle gets no bundle.
    """
    print_lines(map(str, KeyDirectory(home).write_bundles(out, agents, overwrite=overwrite)))


@app.command("inspect")
def inspect_command(
    paths: Annotated[list[Path], typer.Argument(help="Key files, or directories of them.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the facts as JSON.")] = False,
) -> None:
    """Print kind and mission of key files, without secrets.

    Exit status 0: all files are valid and belong to one mission. 1: they belong to several. 2: one is not usable.
    """
    all_facts = [facts for path in paths for facts in inspect(path)]
    if as_json:
        print_json(all_facts)
    else:
        print_lines(map(in_words, all_facts))
    missions = {facts["mission"] for facts in all_facts}
    if len(missions) > 1:
        complain(f"these keys belong to {len(missions)} missions: vehicles of one mission drop the messages of another")
        raise typer.Exit(SEVERAL_MISSIONS)


@app.command("revoke")
def revoke_command(
    home: HomeArgument,
    agents: Annotated[list[int], typer.Argument(help="IDs of the vehicles to revoke.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Also write the revocation message to this file; must be new."),
    ] = None,
) -> None:
    """Revoke the keys of vehicles.

    The command writes the authority's message, which names all vehicles revoked so far. The message is not secret. A
    vehicle that receives it passes it on to the vehicles in its range.
    """
    if out is not None:
        refuse_existing([out])
    key_directory = KeyDirectory(home)
    revocation = key_directory.revoke(agents)
    if out is not None:
        try:
            write_revocation(out, revocation, key_directory.public())
        except OSError as error:
            raise KeysError(f"{out} cannot be written: {error.strerror}; choose another file") from None
    print_lines([in_words(facts) for facts in inspect(key_directory.directory / "revocation.json")])

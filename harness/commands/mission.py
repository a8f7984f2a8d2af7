"""Implement `ucp-harness mission`, which writes the mission files of all vehicles and checks that files belong
together.
"""

import base64
import ipaddress
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness.commands._shared_options import RARE, roster_of
from harness.commands.terminal import complain, print_json, print_lines
from harness.errors import WRONG_REQUEST, extra
from harness.field.depot.mission_comparison import compare
from harness.field.depot.mission_files import MissionFileError, MissionPlan, write
from harness.scenario import Scenario, load_scenario
from harness.scenario.agent_options import quirks_in_words
from harness.scenario.load import parse
from ucp.messages import PORT
from ucp.mission import MAX_INITIAL_DATA_BYTES
from ucp.plain_file import read_plain_file
from ucp.sealed import seal_to

if TYPE_CHECKING:
    from harness.play.keyring.key_directory import KeyDirectory

DIFFERENT = 1

app = typer.Typer(no_args_is_help=True, help="Make the mission files of a swarm, and compare them.")


@app.command("new")
def new_command(
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the files, one for each vehicle.")],
    agents: Annotated[str | None, typer.Option(help="Number of agents, or their IDs, such as 10,28,32.")] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Scenario with the name, roster, settings and events to use.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the mission.")] = None,
    initial_data: Annotated[
        str | None,
        typer.Option(rich_help_panel=RARE, help="Content of BD_0, as text or @FILE; name and time if not given."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--setting", rich_help_panel=RARE, help="Protocol setting, such as vote_timeout_s=8; may be repeated."
        ),
    ] = None,
    events: Annotated[
        list[str] | None,
        typer.Option("--event", rich_help_panel=RARE, help="Event option, such as log=mode,position; may be repeated."),
    ] = None,
    subnet: Annotated[
        str | None,
        typer.Option(rich_help_panel=RARE, help="Subnet, such as 10.1.0.0/16, where vehicle 7 has address 7."),
    ] = None,
    addresses: Annotated[
        list[str] | None,
        typer.Option(
            "--address", rich_help_panel=RARE, help="Other address of a vehicle, such as 7=10.1.0.9; may be repeated."
        ),
    ] = None,
    broadcast: Annotated[
        str | None, typer.Option(rich_help_panel=RARE, help="Broadcast address; that of the subnet if not given.")
    ] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, rich_help_panel=RARE, help="UDP port of all agents.")] = PORT,
    keys: Annotated[
        Path | None,
        typer.Option(metavar="HOME", help="Directory from `keys new`; makes the mission secured."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Write a mission file for each vehicle, and a manifest.

    All files have the same inception block. The manifest holds the parts that all files share.
    """
    requested = _scenario(scenario, agents, name)
    home, data = None if keys is None else _home(keys), _initial_data(initial_data, requested)
    if home is not None:
        home.bundles(requested.roster)  # a missing key must be an error before the first file is written
        depot = home.public().depot
        data = data if depot is None else seal_to(data, depot)
    if requested.has_wrong_agents:
        complain(
            f"{scenario}: its quirks ({', '.join(quirks_in_words(requested.quirks))}) are left out, because mission "
            "files have no quirks"
        )
    plan = MissionPlan(
        requested,
        data,
        settings=_pairs("--setting", settings),
        events=_events(_pairs("--event", events)),
        subnet=_subnet(subnet),
        addresses={_agent_id(key): value for key, value in _texts("--address", addresses).items()},
        broadcast=broadcast,
        port=port,
        secured=home is not None,
    )
    *files, manifest = write(plan, out, overwrite=overwrite)
    if home is not None:
        print_lines(map(str, home.write_bundles(out, requested.roster, overwrite=overwrite)))
    print_lines([*map(str, files), str(manifest), compare([*files, manifest]).in_words()])


@app.command("verify")
def verify_command(
    paths: Annotated[
        list[Path], typer.Argument(help="Mission files, exports, traces, manifests, or directories of them.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print the differences as JSON.")] = False,
) -> None:
    """Check that all files belong to the same mission.

    Exit status 0: all files belong to the same mission. 1: files belong to different missions. 2: no file is usable.
    """
    comparison = compare(paths)
    if as_json:
        print_json(comparison.to_json())
    else:
        print_lines(map(str, comparison.differences))
        if comparison.verdict == "same":
            print_lines([comparison.in_words()])
    if comparison.verdict == "nothing usable":
        complain("none of these files names its mission: give mission files, chain exports or traces")
        raise typer.Exit(WRONG_REQUEST)
    if comparison.verdict == "differ":
        raise typer.Exit(DIFFERENT)


def _scenario(path: Path | None, agents: str | None, name: str | None) -> Scenario:
    """Return a scenario with the name, roster, settings and events of the mission.

    Raises ScenarioError, MissionFileError.
    """
    if path is None and agents is None:
        raise MissionFileError("the roster is missing: give it with --agents 10,28,32, or name a --scenario")
    if path is None:
        return parse({"name": name or "mission", "agents": roster_of(agents or "")})
    requested = load_scenario(path)
    roster = {} if agents is None else {"agents": roster_of(agents)}
    chosen = {"name": name or requested.name, "agents": list(requested.roster), **roster}
    kept = {
        "settings": requested.settings,
        "events": requested.events,
        "quirks": requested.quirks,
        "initial_data": requested.initial_data,
    }
    return parse({**chosen, **kept})


def _home(directory: Path) -> "KeyDirectory":
    with extra("secure", "--keys"):
        from harness.play.keyring.key_directory import KeyDirectory
    return KeyDirectory(directory)


def _initial_data(text: str | None, requested: Scenario) -> bytes:
    if text is None and requested.initial_data is not None:
        return base64.b64decode(requested.initial_data)
    if text is None:
        return f"{requested.name}, made {datetime.now(UTC):%Y-%m-%dT%H:%M:%S.%fZ}".encode()
    if not text.startswith("@"):
        return text.encode(errors="surrogateescape")
    try:
        return read_plain_file(Path(text[1:]), MAX_INITIAL_DATA_BYTES)
    except OSError as error:
        raise MissionFileError(f"{text[1:]} cannot be read: {error.strerror}; name another file for the data") from None


def _subnet(text: str | None) -> ipaddress.IPv4Network | None:
    try:
        return None if text is None else ipaddress.IPv4Network(text)
    except ValueError as error:
        raise MissionFileError(f"`--subnet` is {text!r}, not a network such as 10.1.0.0/16: {error}") from None


def _agent_id(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 10):
        raise MissionFileError(f"`--address` names vehicle {text!r}: use ID=ADDRESS, such as 7=10.1.0.7")
    return int(text)


def _texts(option: str, pairs: list[str] | None) -> dict[str, str]:
    texts = {}
    for pair in pairs or ():
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise MissionFileError(f"`{option}` is {pair!r}: use KEY=VALUE")
        texts[key] = text
    return texts


def _pairs(option: str, pairs: list[str] | None) -> dict[str, object]:
    """Parse the options, which have the form KEY=VALUE. Return key -> value. A value that is not valid JSON becomes a
    text.
    """
    values: dict[str, Any] = {}
    for key, text in _texts(option, pairs).items():
        try:
            values[key] = json.loads(text)
        except (ValueError, RecursionError):
            values[key] = text
    return values


def _events(values: dict[str, Any]) -> dict[str, object]:
    """Split the value of `log` at its commas, so that the user can write `--event log=mode,position` without
    brackets.
    """
    log = values.get("log")
    return {**values, "log": log.split(",")} if isinstance(log, str) else values

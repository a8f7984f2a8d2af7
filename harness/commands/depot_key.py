"""The option `--depot-key`, of all commands that read what vehicles logged."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from harness.errors import MachineError

if TYPE_CHECKING:
    from ucp.secure.sealing import Depot

DepotKey = Annotated[
    Path | None,
    typer.Option(
        "--depot-key", help="Opens event data that is sealed to the depot: its key, of `ucp-harness keys new`."
    ),
]


def depot_of(path: Path | None) -> "Depot | None":
    """Whose key is in the file; None without a file. Raises KeysError, MachineError."""
    if path is None:
        return None
    try:
        from harness.play.keyring.key_directory import load_depot_key
    except ModuleNotFoundError:
        raise MachineError("--depot-key takes a further package: `pip install ucp-harness[secure]`") from None
    return load_depot_key(path)

"""The option `--bundle`, of all commands that read captures."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from harness.errors import MachineError

if TYPE_CHECKING:
    from ucp.secure.opening import Opener

BundleOption = Annotated[
    Path | None,
    typer.Option("--bundle", help="Opens what a secured mission sealed: any vehicle's, of `ucp-harness keys bundle`."),
]


def opener_of(bundle: Path | None) -> "Opener | None":
    """What opens the datagrams of that vehicle's mission; None without a bundle. Raises KeysError, MachineError."""
    if bundle is None:
        return None
    try:
        from harness.play.keyring import KeysError
        from ucp.secure.bundle import load_bundle
        from ucp.secure.keyfile import KeyFileError
        from ucp.secure.opening import Opener
    except ModuleNotFoundError:
        raise MachineError("--bundle takes a further package: `pip install ucp-harness[secure]`") from None
    try:
        return Opener(load_bundle(bundle))
    except KeyFileError as error:
        raise KeysError(f"--bundle: {error}") from None

"""Define the option --variant of all commands that run scenarios or judge runs."""

from pathlib import Path
from typing import Annotated, Any

import typer

from harness.commands._shared_options import RARE


def variant_option() -> Any:
    """Define the option --variant FILE. The protocol variant in FILE is active until the command ends."""

    def put_in_force(ctx: typer.Context, file: Path | None) -> None:
        if file is not None and not ctx.resilient_parsing:
            from harness.run.variant_in_force import in_force

            ctx.with_resource(in_force(file))

    def command(
        variant: Annotated[
            Path | None,
            typer.Option(
                metavar="FILE",
                callback=put_in_force,
                rich_help_panel=RARE,
                help="Python file with a protocol variant, for agents and judge.",
            ),
        ] = None,
    ) -> None: ...

    single = typer.Typer(add_completion=False)
    single.command()(command)
    (option,) = typer.main.get_command(single).params
    option.expose_value = False
    return option

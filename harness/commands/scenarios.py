"""`ucp-harness scenarios`: the library."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from harness.scenario import library


def scenarios_command() -> None:
    """List the scenarios that come along: `ucp-harness run loss_15` plays one."""
    table = Table.grid(padding=(0, 2))
    for name in library.names():
        table.add_row(Text(name, style="bold", no_wrap=True), Text(library.opening(name)))
    console = Console()
    console.print(table)
    console.print(f"in {library.FOLDER}, to copy and edit", highlight=False, soft_wrap=True, style="dim")

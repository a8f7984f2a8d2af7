"""`ucp-harness watch`: a finished run as a film in the browser."""

import asyncio
import os
import sys
import webbrowser
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from harness.report.live.server_process import require_packages

if TYPE_CHECKING:
    from harness.report.live.feed import Feed

PORT = typer.Option(min=0, max=65535, help="Port of the page on 127.0.0.1; 0 selects a free one.")


def watch_command(
    run: Annotated[Path, typer.Argument(help="Run directory, or a directory made by `import`.")],
    port: Annotated[int, PORT] = 0,
) -> None:
    """Show a recorded run as a film in the browser.

    The film shows map, links, chains, votes and reconciles. Ctrl-C ends the command.
    """
    require_packages()
    from harness.report.live.feed import Feed

    feed = Feed(run)
    with closing(feed):
        try:
            asyncio.run(_show(feed, run, port))
        except KeyboardInterrupt:
            raise typer.Exit(0) from None


async def _show(feed: "Feed", run: Path, port: int) -> None:
    from harness.report.live.change_log import Story
    from harness.report.live.projector import tell_film
    from harness.report.live.server import Server

    with closing(Story()) as story:
        async with Server(story, run, live=False).open(port) as address:
            show_address(Console(), address)
            await tell_film(feed, story)
            await asyncio.Event().wait()


def show_address(console: Console, address: str) -> None:
    """Print the page's address as a link; and open it, for somebody who sits at a desktop."""
    console.print(Text("watch it at "), Text(address, style=f"link {address}"), sep="", soft_wrap=True)
    has_desktop = sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if console.is_terminal and has_desktop:
        webbrowser.open(address)

"""Implement `ucp-harness packets`, which lists the datagrams in packet captures."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from harness.archive.packets.block_names import BlockNames, run_directories
from harness.archive.packets.capture_files import Captures, capture_files, read_captures
from harness.archive.packets.exchanges import (
    MessageFilter,
    RequestAnswers,
    count_losses,
    exchanges_about,
    in_order,
    loss_matrix,
)
from harness.archive.packets.packets_document import document
from harness.archive.packets.transmissions import channel_losses, join
from harness.commands._shared_options import BundleOption, opener_of
from harness.commands.terminal import complain, output, print_lines
from harness.errors import WRONG_REQUEST
from harness.report import packets_text
from harness.report.packets_text import Paint, TransmissionFormatter


def packets_command(
    paths: Annotated[list[Path], typer.Argument(metavar="CAPTURE", help="Run directory, or captures of any kind.")],
    follow: Annotated[
        str | None, typer.Option(metavar="BLOCK", help="Follow one block: 3.12, or the start of its hash.")
    ] = None,
    lost: Annotated[
        bool, typer.Option("--lost", help="Print only datagrams that a vehicle lost, and loss rates.")
    ] = False,
    sender: Annotated[
        int | None, typer.Option("--from", metavar="ID", help="Print only datagrams that this vehicle sent.")
    ] = None,
    receiver: Annotated[
        int | None, typer.Option("--to", metavar="ID", help="Print only datagrams that this vehicle received or lost.")
    ] = None,
    message: Annotated[
        str | None, typer.Option(metavar="NAME", help="Print only messages of this name, such as Commit Block.")
    ] = None,
    between: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="S1 S2", help="Print only datagrams sent between these mission seconds."),
    ] = None,
    bundle: BundleOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the datagrams as JSON.")] = False,
) -> None:
    """Print each captured datagram, its receivers and its answers.

    Vehicles that lost the datagram are named, too.
    """
    selection = MessageFilter(sender, receiver, message, between)
    captures = read_captures(capture_files(paths), opener_of(bundle))
    if captures.used:
        print_lines(_output_lines(captures, selection, follow, lost, as_json, run_directories(paths)))
    for sentence in (*captures.problems, *captures.errors):
        complain(sentence)
    if captures.errors:
        raise typer.Exit(WRONG_REQUEST)


def _output_lines(
    captures: Captures, selection: MessageFilter, follow: str | None, lost: bool, as_json: bool, runs: list[Path]
) -> Iterator[str]:
    everything = join(captures)
    exchanges, names = RequestAnswers(everything), BlockNames(everything, runs)
    selected = list(selection.filter(everything, captures))
    shown = [transmission for transmission in selected if transmission.lost_by] if lost else selected
    chapters = None if follow is None else list(exchanges_about(names.find(follow), shown, exchanges))
    losses = channel_losses(runs)
    if as_json:
        listed = shown if chapters is None else in_order(chapters)
        yield from document(captures, count_losses(selected), listed, exchanges, names, losses)
        return
    texts = TransmissionFormatter(names, _paint(), losses)
    yield packets_text.header(captures)
    if chapters is not None:
        yield from packets_text.exchange_lines(chapters, exchanges, texts)
        return
    yield from packets_text.transmission_lines(shown, exchanges, texts, selection.receiver)
    if lost:
        yield from loss_matrix(count_losses(selected))
    yield from packets_text.totals(captures, selected)


def _paint() -> Paint:
    """Return a function that colours a text red. If the output is no terminal, the function returns the text
    unchanged.
    """
    console = output()
    return partial(typer.style, fg="red") if console.is_terminal and not console.no_color else str

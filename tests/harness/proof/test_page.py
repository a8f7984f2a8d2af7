"""Repeat the quick proofs in the tables of proof-bounds.md and livelock-measurements.md, and compare the results."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from harness.proof import Bounds, Proof, prove
from harness.proof.graph._exploration import explore
from harness.proof.model._global_states import ModelSwarm
from harness.proof.questions._convergence import look

DOCS = Path(__file__).parents[3] / "docs"
PAGE = DOCS / "appendix/proof-bounds.md"
MOST_S = 0.5
"""The test repeats the rows whose proof takes at most this number of seconds, according to the page."""
FEW_STATES = 1_000
"""The test repeats the cells that have at most this number of states, according to the page."""

Row = dict[str, str]


def rows() -> Iterator[Row]:
    """Yield each row of the tables of bounds. The comment above a table has the options of the command."""
    lines = iter(PAGE.read_text().splitlines())
    for line in lines:
        if options := re.fullmatch(r"<!-- prove(.*) -->", line):
            names = cells(next(lines))
            assert set(next(lines)) <= set("|-:")
            while (row := next(lines)).startswith("|"):
                yield {**dict(zip(names, cells(row), strict=True)), "options": options[1]}


def cells(line: str) -> list[str]:
    plain = line.replace("**", "").replace("`", "").replace("\N{EN DASH}", "-")
    return [cell.strip() for cell in plain.strip("|").split("|")]


def bounds_of(row: Row) -> Bounds:
    settings = [word for word in row.get("settings", "-").split(", ") if word != "-"]
    phrases = {"timers in any order", "any block the older", "clocks agree"}
    by_default = "any" if "--clocks any" in row["options"] else "agreed"
    clocks = "agreed" if "clocks agree" in settings else "any" if "any block the older" in settings else by_default
    coincidences = row.get("coincidences", "0" if "--coincidences 0" in row["options"] else "-")
    return Bounds(
        int(row["agents"]),
        int(row["blocks"]),
        row.get("network", "lossy"),  # type: ignore[arg-type]  # it is checked
        tuple(name for name in row.get("faults", "-").split(", ") if name != "-"),
        timers_any="timers in any order" in settings,
        coincidences=at_most(coincidences),
        losses=at_most(row.get("losses", "-")),
        clocks_any=row.get("clocks", clocks) == "any",
        crossing="--no-crossing" not in row["options"],
        settings={
            name: yaml.safe_load(value) for name, value in (word.split() for word in settings if word not in phrases)
        },
    )


def at_most(cell: str) -> int | None:
    return None if cell in ("-", "any number") else int(cell)


def one_chain(proof: Proof) -> str:
    """Return the text in the page's column about one chain.

    The text states how many further votes the states need. In brackets, it lists how many states need at least 1 vote,
    2 votes, and so on.
    """
    live = proof.liveness
    if live is None:
        return "not checked"
    *cannot, last = [f"{states:,}" for states in live.astray]
    if live.lost is not None:
        return f"never, from {last} ({'; '.join(dict.fromkeys([*cannot, last]))})"
    if not cannot:
        return "without another vote"
    return f"{len(cannot)} more vote{'s' if len(cannot) > 1 else ''} ({', '.join(cannot)})"


SMALL = [row for row in rows() if float((row.get("seconds") or row["processor seconds"]).replace(",", "")) <= MOST_S]


def test_page_has_tables() -> None:
    assert len(SMALL) > 25
    assert {row["options"] for row in SMALL} == {"", " --no-crossing"}


@pytest.mark.parametrize("row", SMALL, ids=lambda row: f"{row['agents']}/{row['blocks']} {row['states']}")
def test_row_of_the_page_equals_the_proof(row: Row, tmp_path: Path) -> None:
    proof = prove(bounds_of(row), out=tmp_path / "row.yaml")
    assert proof.complete
    assert proof.flaw is None, "everything holds in every state"
    assert row.get("in every state", "holds") == "holds"
    livelocks = "not checked" if proof.liveness is None else str(len(proof.liveness.cycles))
    found = f"{proof.figures.states:,}", f"{proof.figures.transitions:,}", one_chain(proof), livelocks
    assert found == (row["states"], row["transitions"], row["one chain"], row["livelocks"])


def captured_rows() -> list[Row]:
    """Return the rows of the table about captured agents whose proofs are quick."""
    page = PAGE.read_text()
    head, _, *lines = page.partition("<!-- captured -->\n")[2].partition("\n\n")[0].splitlines()
    found = [dict(zip(cells(head), cells(line), strict=True)) for line in lines]
    return [row for row in found if float(row["seconds"]) <= MOST_S]


def test_page_has_quick_rows_of_captured_agents() -> None:
    assert {row["network"] for row in captured_rows()} == {"lossless", "lossy", "any"}


@pytest.mark.parametrize("row", captured_rows(), ids=lambda row: f"{row['agents']}/{row['blocks']} {row['network']}")
def test_row_of_captured_agent_equals_the_proof(row: Row, tmp_path: Path) -> None:
    agents, sends = int(row["agents"]), row["the attacker sends"]
    lies = 0 if sends == "nothing" else int(sends.split()[0]) if sends[0].isdigit() else 1
    bounds = Bounds(agents, int(row["blocks"]), row["network"], captured=agents, lies=lies)  # type: ignore[arg-type]
    proof = prove(bounds, out=tmp_path / "row.yaml")
    assert proof.complete
    one = "not checked" if proof.liveness is None else one_chain(proof)
    livelocks = "not checked" if proof.liveness is None else str(len(proof.liveness.cycles))
    found = f"{proof.figures.states:,}", f"{proof.figures.transitions:,}", one, livelocks
    assert found == (row["states"], row["transitions"], row["one chain"], row["livelocks"])


class Cell(NamedTuple):
    """A cell of the table of endless cycles. It has the bounds of the cell and the text in it."""

    bounds: Bounds
    said: str


def ways_round() -> Iterator[Cell]:
    """Yield the cells of docs/appendix/livelock-measurements.md that have few states."""
    page = (DOCS / "appendix/livelock-measurements.md").read_text()
    table = page.partition("<!-- ways round -->\n")[2].partition("\n\n")[0]
    head, _, *lines = table.splitlines()
    columns = [[part.split()[0] for part in name.split(", ")] for name in cells(head)[1:]]
    for line in lines:
        changes: dict[str, Any] = {}
        for part in line.split("`")[1::2]:
            changes |= yaml.safe_load(part)
        for (agents, blocks, network), said in zip(columns, cells(line)[1:], strict=True):
            if said and int(re.sub(r"\D", "", said.split()[1])) <= FEW_STATES:
                yield Cell(Bounds(int(agents), int(blocks), network, clocks_any=True, **changes), said)  # type: ignore[arg-type]


CELLS = [*ways_round()]


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: cell.bounds.in_words())
def test_number_of_cycles_equals_that_of_the_page(cell: Cell) -> None:
    graph = explore(ModelSwarm(cell.bounds), most_bytes=4e9, most_s=600)
    assert graph.ended == "complete"
    assert f"{len(look(graph).cycles)} ({len(graph.states):,})" == cell.said


def test_checked_cells_have_and_lack_cycles() -> None:
    assert len(CELLS) > 20
    assert {cell.said.startswith("0 ") for cell in CELLS if cell.bounds.stagger} == {True}
    assert {cell.said.startswith("0 ") for cell in CELLS if not cell.bounds.stagger} == {True, False}

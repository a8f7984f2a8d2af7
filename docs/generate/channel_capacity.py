"""Measure how many vehicles a shared radio channel can serve: `python -m docs.generate.channel_capacity`.

Each cell of the measurement is a mission with a radio, a number of agents, and a value of the channel's key
`processing_s` (the spread). All cells use the same seeds. This program draws the picture for
docs/explanation/channel-capacity.md and writes the tables of this page. The text around them is written by hand.
"""

import math
import random
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from markupsafe import Markup

from harness.present import svg
from harness.present.svg import ChartArea
from harness.run.parallel import FailedTask, sweep
from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.sweep.matrix._estimate import estimate_mean, estimate_share
from ucp.agent_files import write_atomically

PAGE = Path(__file__).parents[1] / "explanation/channel-capacity.md"
PICTURE = PAGE.with_name("channel-capacity.svg")

Mission = Literal["steady", "busy", "split"]
MISSIONS: dict[Mission, tuple[int, ...]] = {
    "steady": (2, 5, 10, 20, 30, 50),
    "busy": (2, 5, 10, 20, 30),
    "split": (2, 5, 10, 20, 30),
}
"""The numbers of agents with which each mission is measured."""
RADIOS = ("wifi_1", "wifi_6", "rfd900", "lora_sf7")
SPREADS_S = (0.0005, 0.005, 0.05, 0.5)
DEFAULT_SPREAD_S = 0.005
SEEDS = 10

DURATION_S = 300.0
SETTLE_S = 600.0
BLOCKS = 10
"""Total number of blocks that the agents complete in each of the missions `steady` and `split`."""
BUSY_BLOCKS_PER_AGENT = 1.5
EVENT_BYTES = 110
"""Each event completes a block, because `max_block_bytes` has room for one event of this size."""
MAX_BLOCK_BYTES = 128
SPLIT_S, APART_S = 60.0, 120.0

CARRIED = 0.95
"""A radio can serve a swarm if, on average, every chain contains at least this share of the completed blocks."""

SPREAD_SIZES: tuple[tuple[Mission, int], ...] = (("steady", 50), ("busy", 20))
"""Missions and numbers of agents in the table that compares the values of SPREADS_S."""
ASKING_RADIOS, ASKING_AGENTS = ("wifi_1", "wifi_6", "rfd900"), (10, 20)
ASKING_MISSIONS: tuple[Mission, ...] = ("busy", "split")
LINES = ((5, 200.0), (10, 100.0))
"""The number of vehicles in each line, and the metres between neighbours."""
LINE_SPREADS_S = (0.0005, 0.005, 0.5)
ANSWER_SPREADS_S = (0.0, 0.05, 0.5, 2.0)
"""Values of the setting `answer_spread_s` that the page compares."""
ANSWERING: tuple[tuple[Mission, str, int, float | None], ...] = (
    ("steady", "wifi_1", 50, None),
    ("steady", "wifi_6", 50, None),
    ("busy", "wifi_6", 20, None),
    ("busy", "rfd900", 10, None),
    ("busy", "lora_sf7", 5, None),
    ("steady", "wifi_6", 10, 100.0),
)
"""The rows of the table that compares values of `answer_spread_s`.

Each row has a mission, a radio, a number of agents, and the metres between neighbours in a line (None for a field).
"""

HEAD, PANEL_HEIGHT, FOOT = 96, 210, 26
DISTURBED = ("collision", "half_duplex")
OUT_OF_REACH = ("range", "fade")


class Cell(NamedTuple):
    """A mission with a radio. If `radio` is None, the network loses nothing."""

    mission: Mission
    radio: str | None
    agents: int
    spread_s: float = DEFAULT_SPREAD_S
    asks_after_commit: bool = False
    line_m: float | None = None
    """Metres between neighbours in a line. If the value is None, the vehicles form a field with 5 m between them."""
    answer_spread_s: float = 0.0


class Run(NamedTuple):
    """The figures of a run. A figure is None if the run does not determine it."""

    finished: bool
    in_every_chain: float
    """Share of the completed blocks that every chain contains."""
    copies: float
    """Share of the chains that contain a completed block, as the mean over all completed blocks."""
    messages_per_block: float
    airtime_per_block_s: float | None
    disturbed: float | None
    """Share of the copies of frames that a receiver lost because of a collision or because it was sending."""
    out_of_reach: float | None
    """Share of the copies of frames that a receiver lost because of distance or shadowing."""
    collisions: int | None
    one_chain_after_s: float | None
    """Seconds from the last completed block until all chains are equal."""


Runs = Mapping[Cell, Sequence[Run]]


def cells() -> list[Cell]:
    """Return all cells that the page needs."""
    grid = [
        Cell(mission, radio, agents, spread_s)
        for mission, numbers in MISSIONS.items()
        for agents in numbers
        for radio in RADIOS
        for spread_s in SPREADS_S
    ]
    without = [Cell(mission, None, agents) for mission, numbers in MISSIONS.items() for agents in numbers]
    return [*grid, *without, *_asking(True), *_lines(), *_answering()]


def scenario(cell: Cell, seed: int) -> Scenario:
    """Return the scenario of a run. The seed decides which agents complete blocks, and when."""
    draws = random.Random(f"{cell.mission}/{cell.agents}/{seed}")
    blocks = round(BUSY_BLOCKS_PER_AGENT * cell.agents) if cell.mission == "busy" else BLOCKS
    script = [
        {"at_s": at_s, "agent": draws.randint(1, cell.agents), "bytes": EVENT_BYTES}
        for at_s in sorted(draws.uniform(5, DURATION_S - 5) for _ in range(blocks))
    ]
    half = [*range(1, cell.agents // 2 + 1)]
    line = {index: [0, index * cell.line_m, 0, 0] for index in range(cell.agents)} if cell.line_m else {}
    document: dict[str, Any] = {
        "name": "channel capacity",
        "agents": cell.agents,
        "duration_s": DURATION_S,
        "settle": {"limit_s": SETTLE_S},
        "events": {"source": "scripted", "script": script},
        "settings": {
            "max_block_bytes": MAX_BLOCK_BYTES,
            "max_event_bytes": MAX_BLOCK_BYTES,
            "asks_after_commit": cell.asks_after_commit,
            "answer_spread_s": cell.answer_spread_s,
        },
        "vehicles": {"swarm": line},
        "network": {"channel": {"preset": cell.radio, "processing_s": cell.spread_s}} if cell.radio else {},
        "timeline": [{"at_s": SPLIT_S, "partition": [half], "for_s": APART_S}] if cell.mission == "split" else [],
    }
    return Scenario.model_validate(document)


def play(task: tuple[Cell, int]) -> Run:
    """Play a mission with a seed, and return the figures of the run."""
    cell, seed = task
    played = scenario(cell, seed)
    simulated = simulate(played, seed)
    figures = simulated.result.figures
    blocks, mutual, messages = figures["blocks"], figures["mutual_chain"], figures["messages_per_block"]
    copies_mean = figures["copies_mean"]
    assert blocks and mutual is not None and messages is not None and copies_mean is not None
    one_chain_at_s, last_s = figures["uniform_at_s"], played.events.script[-1].at_s
    record = simulated.evidence.record
    channel = record.channel if record else None
    heard = channel.frames * (cell.agents - 1) if channel else 0
    return Run(
        finished=simulated.played.settled,
        in_every_chain=mutual / blocks,
        copies=copies_mean / cell.agents,
        messages_per_block=messages,
        airtime_per_block_s=channel.airtime_s / blocks if channel else None,
        disturbed=sum(map(channel.total, DISTURBED)) / heard if channel and heard else None,
        out_of_reach=sum(map(channel.total, OUT_OF_REACH)) / heard if channel and heard else None,
        collisions=channel.total("collision") if channel else None,
        one_chain_after_s=None if one_chain_at_s is None else max(0.0, one_chain_at_s - last_s),
    )


def carried(runs: Runs, mission: Mission, radio: str | None, spread_s: float) -> int:
    """Return the largest measured number of agents that the radio can serve, or 0 if it can serve none."""
    most = 0
    for agents in MISSIONS[mission]:
        those = runs[Cell(mission, radio, agents, spread_s)]
        share = sum(run.in_every_chain for run in those) / len(those)
        if share < CARRIED or not all(run.finished for run in those):
            break
        most = agents
    return most


def tables(runs: Runs) -> dict[str, str]:
    """Return the tables by name, as Markdown."""
    size_cells = [Cell("busy", radio, agents) for radio in (None, *RADIOS) for agents in MISSIONS["busy"]]
    spread_cells = [
        Cell(mission, radio, agents, spread_s)
        for mission, agents in SPREAD_SIZES
        for radio in ASKING_RADIOS
        for spread_s in SPREADS_S
    ]
    return {
        "carries": _carries(runs),
        "size": _markdown(["radio", "N", *COLUMNS], (size_row(cell, runs[cell]) for cell in size_cells)),
        "spread": _markdown(
            ["mission", "N", "radio", "spread", *COLUMNS],
            (
                [cell.mission, str(cell.agents), _radio(cell), _seconds(cell.spread_s), *_figures(runs[cell])]
                for cell in spread_cells
            ),
        ),
        "answers": _markdown(
            ["mission", "N", "radio", "`answer_spread_s`", *COLUMNS],
            (
                [
                    f"{cell.mission}, in a line" if cell.line_m else cell.mission,
                    str(cell.agents),
                    _radio(cell),
                    _seconds(cell.answer_spread_s),
                    *_figures(runs[cell]),
                ]
                for cell in _answering()
            ),
        ),
        "asking": _asking_table(runs),
        "line": _markdown(
            ["N", "between neighbours", "spread", "out of reach", *COLUMNS],
            (
                [
                    str(cell.agents),
                    f"{cell.line_m:g}\u00a0m",
                    _seconds(cell.spread_s),
                    _mean([run.out_of_reach for run in runs[cell]], percent=True),
                    *_figures(runs[cell]),
                ]
                for cell in _lines()
            ),
        ),
    }


COLUMNS = (
    "finished",
    "in every chain",
    "chains with a block",
    "messages per block",
    "airtime per block",
    "copies disturbed",
    "collisions",
    "one chain after",
)


def size_row(cell: Cell, those: Sequence[Run]) -> list[str]:
    """Return the row of a mission in the table of swarm sizes."""
    return [_radio(cell), str(cell.agents), *_figures(those)]


def _figures(those: Sequence[Run]) -> list[str]:
    finished = estimate_share(sum(run.finished for run in those), len(those))
    assert finished.mean is not None and finished.low is not None and finished.high is not None
    interval = f"{100 * finished.low:.0f}\u2013{100 * finished.high:.0f}"
    late = [run.one_chain_after_s for run in those]
    known = sum(at_s is not None for at_s in late)
    return [
        f"{100 * finished.mean:.0f}\u00a0%<br><sub>{interval}\u00a0%</sub>",
        _mean([run.in_every_chain for run in those], percent=True),
        _mean([run.copies for run in those], percent=True),
        _mean([run.messages_per_block for run in those]),
        _mean([run.airtime_per_block_s for run in those], unit="\u00a0s"),
        _mean([run.disturbed for run in those], percent=True),
        _mean([run.collisions for run in those]),
        _mean(late, unit="\u00a0s") + (f"<br><sub>{known} runs</sub>" if 0 < known < len(those) else ""),
    ]


def _mean(values: Iterable[float | None], *, percent: bool = False, unit: str = "") -> str:
    """Return the mean and the margin of its 95 % confidence interval as text."""
    estimate = estimate_mean([value for value in values if value is not None])
    if estimate.mean is None:
        return "\u2013"
    factor, unit = (100, "\u00a0%") if percent else (1, unit)
    margin = "" if estimate.high is None else f"<br><sub>±{_number(factor * (estimate.high - estimate.mean))}</sub>"
    return f"{_number(factor * estimate.mean)}{unit}{margin}"


def _number(value: float) -> str:
    """Return a number with three significant digits as text."""
    if value == 0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{digits}f}".replace(",", "\u202f")


def _carries(runs: Runs) -> str:
    body = []
    for mission, numbers in MISSIONS.items():
        without = carried(runs, mission, None, DEFAULT_SPREAD_S)
        for radio in RADIOS:
            found = (carried(runs, mission, radio, spread_s) for spread_s in SPREADS_S)
            body.append([mission, f"`{radio}`", *(_most(most, numbers) for most in (*found, without))])
    return _markdown(["mission", "radio", *map(_seconds, SPREADS_S), "no channel"], body)


def _asking_table(runs: Runs) -> str:
    """Return a table that compares runs with the same seed without and with the setting `asks_after_commit`."""
    body = []
    for off, on in zip(_asking(False), _asking(True), strict=True):
        fields = [off.mission, _radio(off), str(off.agents)]
        for name, percent in (("in_every_chain", True), ("messages_per_block", False)):
            without, asking = ([getattr(run, name) for run in runs[cell]] for cell in (off, on))
            differences = [after - before for before, after in zip(without, asking, strict=True)]
            fields += [_mean(values, percent=percent) for values in (without, asking, differences)]
        body.append(fields)
    columns = ("without", "with", "difference")
    names = [f"{name}, {column}" for name in ("in every chain", "messages per block") for column in columns]
    return _markdown(["mission", "radio", "N", *names], body)


def _most(most: int, numbers: Sequence[int]) -> str:
    return f"{most} or more" if most == numbers[-1] else str(most) if most else f"fewer than {numbers[0]}"


def _radio(cell: Cell) -> str:
    return f"`{cell.radio}`" if cell.radio else "no channel"


def _seconds(seconds: float) -> str:
    return f"{1000 * seconds:g}\u00a0ms"


def _asking(asks: bool) -> list[Cell]:
    return [
        Cell(mission, radio, agents, asks_after_commit=asks)
        for mission in ASKING_MISSIONS
        for radio in ASKING_RADIOS
        for agents in ASKING_AGENTS
    ]


def _lines() -> list[Cell]:
    return [
        Cell("steady", "wifi_6", agents, spread_s, line_m=line_m)
        for agents, line_m in LINES
        for spread_s in LINE_SPREADS_S
    ]


def _answering() -> list[Cell]:
    return [
        Cell(mission, radio, agents, line_m=line_m, answer_spread_s=spread_s)
        for mission, radio, agents, line_m in ANSWERING
        for spread_s in ANSWER_SPREADS_S
    ]


def _markdown(headers: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = [headers, ["--:" for _ in headers], *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


SHOWN = {
    "in every chain": "in_every_chain",
    "copies disturbed": "disturbed",
    "airtime per block": "airtime_per_block_s",
}
"""The figure that each panel shows, by the title of the panel."""


def draw(runs: Runs) -> str:
    """Draw the mission `busy`. Each radio has a row of charts, and each spread has a line."""
    areas = svg.grid(len(SHOWN) * len(RADIOS), len(SHOWN), HEAD, PANEL_HEIGHT)
    places = [(radio, shown) for radio in RADIOS for shown in SHOWN]
    return svg.document(
        HEAD + len(RADIOS) * PANEL_HEIGHT + FOOT,
        "How many vehicles can one channel carry?",
        f"mission busy \u00b7 {DURATION_S:g} s, {SETTLE_S:g} s to settle \u00b7 {SEEDS} runs per dot",
        _description(runs),
        [_legend(), *(_panel(runs, *place, area) for place, area in zip(places, areas, strict=True))],
        "Over the number of agents N. Dots: means of the runs.",
        ids="capacity-",
    )


def _value(runs: Runs, cell: Cell, shown: str) -> float:
    values: list[float] = [getattr(run, SHOWN[shown]) or 0.0 for run in runs[cell]]
    return sum(values) / len(values)


def _panel(runs: Runs, radio: str, shown: str, area: ChartArea) -> Markup:
    numbers = MISSIONS["busy"]
    across = svg.Axis(numbers[0] * 0.9, numbers[-1] * 1.1, *area.across, numbers, log=True)
    lines = [
        [(agents, _value(runs, Cell("busy", radio, agents, spread_s), shown)) for agents in numbers]
        for spread_s in SPREADS_S
    ]
    values = [value for line in lines for _, value in line]
    share = shown != "airtime per block"
    up = svg.share_axis(area.up) if share else svg.log_axis(min(values), max(values), area.up)
    ticks = [f"{100 * tick:.0f}\u00a0%" if share else f"{tick:g}\u00a0s" for tick in up.ticks]
    parts = [svg.frame(f"{radio}: {shown}", across, up, map(str, numbers), ticks)]
    for number, line in enumerate(lines):
        dots = [
            svg.dot(across(agents), up(value), number, f"{agents} agents, {_seconds(SPREADS_S[number])}: {value:.3g}")
            for agents, value in line
        ]
        drawn = svg.line([(across(agents), up(value)) for agents, value in line], number)
        parts.append(Markup('<g class="series {}">{}{}</g>').format(svg.CLASSES[number], drawn, Markup("").join(dots)))
    return Markup('<g class="panel">{}</g>\n').format(Markup("").join(parts))


def _legend() -> Markup:
    parts = []
    for number, spread_s in enumerate(SPREADS_S):
        x = svg.MARGIN + 4.0 + 150 * number
        parts.append(
            Markup('<g class="series {}">{}{}</g>').format(
                svg.CLASSES[number],
                svg.line([(x, 77), (x + 26, 77)], number),
                svg.name(x + 32, 81, "start", number, f"spread {_seconds(spread_s)}"),
            )
        )
    return Markup("").join(parts)


def _description(runs: Runs) -> str:
    """Return a text that describes the picture."""
    return " ".join(
        f"{radio}, {shown}: "
        + ", ".join(
            f"{_value(runs, Cell('busy', radio, agents), shown):.3g} at {agents} agents" for agents in MISSIONS["busy"]
        )
        + "."
        for radio in RADIOS
        for shown in SHOWN
    )


def put(page: str, name: str, table: str) -> str:
    """Replace the table with this name in the text of the page."""
    begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->\n"
    before, rest = page.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}{table}{end}{after}"


def main(jobs: int) -> None:
    runs: dict[Cell, list[Run]] = defaultdict(list)
    tasks = [(cell, seed) for cell in cells() for seed in range(1, SEEDS + 1)]
    with sweep(tasks, play, jobs, what="runs") as outcomes:
        for task, outcome in outcomes:
            if isinstance(outcome, FailedTask):
                raise SystemExit(f"{task}: {outcome.reason}")
            runs[task[0]].append(outcome)
    page = PAGE.read_text(encoding="utf-8")
    for name, table in tables(runs).items():
        page = put(page, name, table)
    write_atomically(PAGE, page)
    write_atomically(PICTURE, draw(runs))


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 1)

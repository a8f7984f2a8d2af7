"""Display an active run: mission time, chain lengths and reconciling agents. After the mission, display the progress of
the checker.

A terminal shows a live table. If the output is no terminal, for example in CI logs, the display prints a line every few
seconds.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from harness.play.agent_control import AgentStatus

LINE_EVERY_S = 10.0


@dataclass(frozen=True)
class SwarmSnapshot:
    """The state of a swarm at one moment."""

    stage: str
    mission_s: float
    duration_s: float
    network: str
    statuses: Mapping[int, AgentStatus | None]
    """The last status report of each agent, by agent ID. The value is None before the first report."""


class ProgressDisplay(Protocol):
    """A display of the progress of a run."""

    def show(self, snapshot: SwarmSnapshot) -> None: ...
    def show_judging(self, step: str) -> None:
        """Show which step the checker is performing after the mission, such as "reading trace 3 of 50"."""

    def close(self) -> None: ...


class SilentProgress:
    """A display without output, for programs that call the harness."""

    def show(self, snapshot: SwarmSnapshot) -> None:
        pass

    def show_judging(self, step: str) -> None:
        pass

    def close(self) -> None:
        pass


class ProgressLines:
    """A display that prints a line when the stage of the mission changes, and every few seconds."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._stage = ""
        self._last = 0.0
        self._line = ""

    def show(self, snapshot: SwarmSnapshot) -> None:
        now = time.monotonic()
        if snapshot.stage == self._stage and now - self._last < LINE_EVERY_S:
            return
        self._stage, self._last = snapshot.stage, now
        line = f"{_minutes(snapshot.mission_s)} {snapshot.stage}"
        if any(snapshot.statuses.values()):
            known = {agent: status for agent, status in snapshot.statuses.items() if status}
            chains = " ".join(f"{agent}:{status.chain}" for agent, status in known.items())
            reconciling = [agent for agent, status in known.items() if status.reconcile_in_progress]
            line += f"; chain lengths {chains}; {_reconciling(reconciling)}; {snapshot.network}"
        if line != self._line:  # without progress of time, the line is the same
            self._console.print(line, highlight=False, soft_wrap=True)
        self._line = line

    def show_judging(self, step: str) -> None:
        if time.monotonic() - self._last >= LINE_EVERY_S:
            self._last = time.monotonic()
            self._console.print(step, highlight=False, soft_wrap=True)

    def close(self) -> None:
        pass


class ProgressTable:
    """A table that is updated during the run and removed at its end."""

    def __init__(self, console: Console) -> None:
        self._live = Live(console=console, transient=True, auto_refresh=False)
        self._live.start()

    def show(self, snapshot: SwarmSnapshot) -> None:
        self._live.update(_render(snapshot), refresh=True)

    def show_judging(self, step: str) -> None:
        self._live.update(Text(step), refresh=True)

    def close(self) -> None:
        self._live.stop()


def for_console(console: Console) -> ProgressDisplay:
    return ProgressTable(console) if console.is_terminal else ProgressLines(console)


def _render(snapshot: SwarmSnapshot) -> RenderableType:
    table = Table.grid(padding=(0, 2))
    for _ in range(6):
        table.add_column(justify="right")
    table.add_row("agent", "chain", "waiting", "completed", "reconciles", "", style="dim")
    for agent, status in snapshot.statuses.items():
        if status is None:
            table.add_row(str(agent))
            continue
        doing = "reconciling" if status.reconcile_in_progress else "" if status.idle else "voting"
        numbers = (status.chain, status.deque, status.completed, status.reconciles)
        table.add_row(str(agent), *map(str, numbers), Text(doing, style="yellow" if doing == "reconciling" else ""))
    elapsed_s, over_s = min(snapshot.mission_s, snapshot.duration_s), snapshot.mission_s - snapshot.duration_s
    times = f"{_minutes(elapsed_s)} of {_minutes(snapshot.duration_s)}{f' + {_minutes(over_s)}' if over_s >= 1 else ''}"
    head = Table.grid(padding=(0, 2))
    head.add_row(ProgressBar(total=snapshot.duration_s, completed=elapsed_s, width=30), times, snapshot.stage)
    return Group(head, Text(snapshot.network, style="dim"), table)


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02}"


def _reconciling(agents: list[int]) -> str:
    return f"reconciling: {' '.join(map(str, agents)) or 'none'}"

"""Follow the network conditions, faults and vehicle positions of a run, and convert them to changes for the live
page.
"""

from collections.abc import Callable, Collection
from itertools import combinations
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import ValidationError

from harness.archive.connectivity import NETWORK_FILE, NetworkLine, NetworkReplay, Pair
from harness.archive.tracks import TRACKS_FILE, TrackLine
from harness.report.live._agent_course import Change, GrowingFile
from harness.scenario.changes import RANGE
from harness.scenario.faults import fault_class
from harness.scenario.faults.fault import PAUSED, Fault

MAX_DETAIL = 300


class _TimedNetworkLine(NetworkLine):
    detail: Any = ""
    """A text for the user that describes the change."""
    by_hand: bool = False


TimedLine = TypeVar("TimedLine", _TimedNetworkLine, TrackLine)


class _TimedFile(Generic[TimedLine]):
    """A growing file whose entries have times. `model` validates each line. When the caller reads up to a mission
    second, `play` processes all lines up to this second.
    """

    def __init__(self, path: Path, model: type[TimedLine], play: Callable[[TimedLine], None]) -> None:
        self._file = GrowingFile(path)
        self._model: type[TimedLine] = model
        self._play: Callable[[TimedLine], None] = play
        self.ahead: TimedLine | None = None
        """An entry that was already read, but that is later than the mission second up to which the caller reads."""
        self.at_s = 0.0
        """Mission second of the last entry that was processed."""
        self.problems: dict[str, None] = {}

    def read(self, until_s: float, at_most: int) -> bool:
        """Read the file up to mission second `until_s`, but at most `at_most` lines. Return true if there are further
        entries up to `until_s`.
        """
        name = self._file.path.name
        for _ in range(at_most):
            entry, self.ahead = self.ahead, None
            if entry is None:
                if (text := self._file.next()) is None:
                    if self._file.trouble:
                        self.problems[f"{name} {self._file.trouble}"] = None
                    return False
                try:
                    entry = self._model.model_validate_json(text)
                except ValidationError:
                    self.problems[f"{name} has damaged lines, which are left out"] = None
                    continue
            if entry.at_s > until_s:
                self.ahead = entry
                return False
            self.at_s = max(self.at_s, entry.at_s)
            try:
                self._play(entry)
            except (ValueError, TypeError, AttributeError, KeyError):
                self.problems[f"{name} has unknown lines, which are left out"] = None
        return True

    def close(self) -> None:
        self._file.close()


class NetworkAndVehicles:
    """The network and the vehicles of a run, according to the parts of the files that were read so far. Callers read
    the list `changes`, and then empty it.
    """

    def __init__(self, directory: Path, vehicles: Collection[int]) -> None:
        self.changes: list[Change] = []
        self._known = set(vehicles)
        self._network = NetworkReplay(vehicles)
        self._losses: dict[Pair, tuple[float, float]] = {}
        self._parts: tuple[frozenset[int], ...] = ()
        self._conditions = _TimedFile(directory / NETWORK_FILE, _TimedNetworkLine, self._play_network_entry)
        self._tracks = _TimedFile(directory / TRACKS_FILE, TrackLine, self._play_positions)

    def read(self, until_s: float, at_most: int) -> bool:
        """Read the growing files up to mission second `until_s`, but at most `at_most` lines of each file.

        Return true if there are further entries up to `until_s`.
        """
        more = self._conditions.read(until_s, at_most)
        return self._tracks.read(until_s, at_most) or more

    @property
    def at_s(self) -> float:
        """The mission second of the latest entry that was read from the files."""
        return max(self._conditions.at_s, self._tracks.at_s)

    @property
    def next_s(self) -> float | None:
        """The mission second of the next entry, which was already read but is not processed yet. The value is None if
        there is no such entry.
        """
        ahead = (self._conditions.ahead, self._tracks.ahead)
        return min((line.at_s for line in ahead if line is not None), default=None)

    @property
    def problems(self) -> list[str]:
        """A sentence for each file that cannot be read completely."""
        return [*self._conditions.problems, *self._tracks.problems]

    def close(self) -> None:
        self._conditions.close()
        self._tracks.close()

    def _play_network_entry(self, line: _TimedNetworkLine) -> None:
        """Process one entry: a change of the network or a fault of agents.

        Raises ValueError, TypeError, AttributeError or KeyError if the line is invalid.
        """
        if not self._parts and line.asked is None:
            raise ValueError("the record begins with conditions")
        network = self._network
        network.apply(line)
        fault = fault_class(line.what)
        whole = line.asked is not None or fault.removes_vehicle or fault.adds_vehicle
        pairs = [*combinations(network.vehicles, 2)] if whole else [_pair(name) for name in line.losses]
        losses = {pair: _rounded(network.directions(pair)) for pair in pairs}
        changed = [[*pair, *loss] for pair, loss in losses.items() if self._losses.get(pair) != loss]
        self._losses |= losses
        parts = network.components() if changed or not self._parts else self._parts
        named_parts = None if parts == self._parts else [sorted(part) for part in parts]
        self._parts = parts
        agents = [agent for agent in line.agents if agent in self._known]
        what = "" if line.what in (RANGE, "end") else line.what
        detail = str(line.detail)[:MAX_DETAIL]
        self.changes.append(
            ["n", line.at_s, what, detail, agents, _state_after(fault), changed, named_parts, line.by_hand]
        )

    def _play_positions(self, line: TrackLine) -> None:
        places = {str(vehicle): place for vehicle, place in line.places.items() if vehicle in self._known}
        self.changes.append(["p", line.at_s, places])


def _state_after(fault: type[Fault]) -> str:
    """Return one word for the state of an agent after a fault. Return an empty text if the fault does not change the
    state.
    """
    states = {
        "gone": fault.removes_vehicle,
        "down": fault.ends_incarnation,
        "back": fault.begins_incarnation,
        "still": fault.suspends_agent,
        "awake": PAUSED in fault.states_before,
    }
    return next((state for state, is_so in states.items() if is_so), "")


def _rounded(losses: tuple[float, float]) -> tuple[float, float]:
    there, back = losses
    return round(there, 3), round(back, 3)


def _pair(name: str) -> Pair:
    low, _, high = name.partition("-")
    return int(low), int(high)

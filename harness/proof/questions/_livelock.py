"""Describe the livelocks (endless cycles of agents), and write an example of each form with the conditions under which
it occurs.

Two cycles have the same form if the same timers run in their states. The agents and the chains make no difference.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from harness.archive.run_record import Cycle
from harness.proof.examples._example import PlayedExample, ViolationExample, keep, play
from harness.proof.examples._path_script import NO_CLOCKS, CompletionInterval, Document, PathScript
from harness.proof.graph._exploration import StateGraph
from harness.proof.model._global_states import AGENTS
from harness.proof.model._known_states import DEAD

MAX_FORMS = 12
"""Maximum number of forms for which an example is played. Forms that are possible with real clocks come first. Within
each group, the forms nearest to the initial state come first.
"""
MAX_PLAYED = 5
"""Maximum number of cycles of one form that are played to find one that the simulation confirms."""
ROUNDS = 3
"""Number of rounds of a cycle for which the possible completion times of blocks are computed."""

_Form = tuple[tuple[tuple[tuple[int, ...], bool], ...], ...]


@dataclass(frozen=True)
class Livelock:
    """All endless cycles of one form, with an example.

    - `ways`: number of components of the graph with a cycle of this form.
    - `coincidences`: number of coincidences on the path of the example. In a coincidence, two instants have the same
      time by chance, up to the transit time of a message. Another path may need fewer. None if timers expire in any
      order.
    - `completions`: for each block on the path, the interval in which the block can be completed.
    - `losses`: number of lost messages on the path. A message counts once for each receiver that loses it.
    - `cycle`: the cycle that the simulation of the example showed. None if the simulation took a different path.
    - `contradictory`: true if the path is impossible with real clocks, because its ties require contradictory ages of
      blocks.
    """

    ways: int
    coincidences: int | None
    completions: tuple[CompletionInterval, ...]
    example: ViolationExample
    losses: int
    cycle: Cycle | None
    contradictory: bool = False

    def to_json(self) -> dict[str, object]:
        return {
            "ways": self.ways,
            "coincidences": self.coincidences,
            "losses": self.losses,
            "contradictory": self.contradictory,
            "completions": [completion._asdict() for completion in self.completions],
            "cycle": None if self.cycle is None else self.cycle.model_dump(mode="json"),
            "example": self.example.to_json(),
        }

    def in_words(self) -> str:
        """Describe the conditions of the endless cycle."""
        if not self.losses:
            return self._timings_in_words()
        return f"{self._timings_in_words()}; {self.losses} loss{'es lead' if self.losses > 1 else ' leads'} there"

    def _timings_in_words(self) -> str:
        if self.contradictory:
            return NO_CLOCKS
        if self.coincidences is None:
            return "if timers can expire in this order, and one of them may wait for ever"
        if not self.coincidences and self.cycle is None:
            return "without a coincidence, if messages sent at the same instant arrive in the same order in every round"
        if not self.coincidences:
            return "which needs no coincidence"
        moments = "two instants are" if self.coincidences == 1 else f"{self.coincidences} times two instants are"
        return f"on this path {moments} equal by chance, to within the transit time of a message"


def forms(graph: StateGraph, cycles: Sequence[list[int]]) -> list[list[list[int]]]:
    """Return the cycles grouped by form. The form nearest to the initial state is first."""
    alike: dict[_Form, list[list[int]]] = defaultdict(list)
    for cycle in cycles:
        alike[_form(graph, cycle)].append(cycle)
    return list(alike.values())


def _form(graph: StateGraph, cycle: Sequence[int]) -> _Form:
    """Return the form of a cycle. It does not depend on the state at which the list of the cycle begins."""
    known = graph.swarm.local.known
    agents_at = [
        tuple(
            sorted(
                (known[local].running, known[local].waits) for local in graph.states[number][AGENTS:] if local != DEAD
            )
        )
        for number in cycle
    ]
    return min(tuple(agents_at[first:] + agents_at[:first]) for first in range(len(agents_at)))


def in_timers(graph: StateGraph, cycles: Sequence[list[int]]) -> list[str]:
    """Return the forms of the cycles as text. The text lists the timers of each agent for each state of the cycle."""
    names = graph.swarm.local.timers

    def agent(running: tuple[int, ...], waits: bool) -> str:
        return "+".join(names[timer] for timer in running) or ("waiting" if waits else "idle")

    def form(cycle: Sequence[int]) -> str:
        return " > ".join(", ".join(agent(*state) for state in agents) for agents in _form(graph, cycle))

    return sorted({form(cycle) for cycle in cycles})


class _CycleExample(NamedTuple):
    """An example of a cycle: the path to it, one round of it, and the scenario."""

    begin: list[int]
    cycle: list[int]
    script: PathScript
    document: Document


def show(graph: StateGraph, cycles: Sequence[list[int]], path: Path, name: str) -> Iterator[Livelock]:
    """Write an example of each form of these cycles, and yield a livelock for each form. The first example is written
    to `path`, and the others to files next to it.
    """
    by_form = [(len(alike), _nearest(graph, alike)) for alike in forms(graph, cycles)]
    by_form.sort(key=lambda form: form[1][0].script.contradictory)
    for number, (ways, rounds) in enumerate(by_form[:MAX_FORMS], 1):
        file = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
        yield _livelock_of(graph, ways, rounds, file, name if number == 1 else f"{name} {number}")


def _nearest(graph: StateGraph, alike: Sequence[list[int]]) -> list[_CycleExample]:
    """Return some of the cycles `alike`, which all have the same form. The best example comes first. Cycles that are
    possible with real clocks come before the others. Among these, cycles with fewer coincidences come first, and among
    these, cycles with fewer blocks whose completion time is fixed.
    """
    tried: list[tuple[bool, int, int, _CycleExample]] = []
    for cycle in sorted(alike, key=lambda cycle: len(graph.path(cycle[0])))[:MAX_PLAYED]:
        begin = graph.path(cycle[0])
        script = PathScript(graph, [*begin, *cycle[1:], cycle[0]])
        document = script.document("")
        any_time = graph.swarm.bounds.timers_any
        bound = 0 if any_time else sum(each.earliest_s == each.latest_s for each in script.completions())
        tried.append((script.contradictory, script.coincidences, bound, _CycleExample(begin, cycle, script, document)))
    return [each for *_, each in sorted(tried, key=lambda one: one[:3])]


def _livelock_of(graph: StateGraph, ways: int, rounds: Sequence[_CycleExample], path: Path, name: str) -> Livelock:
    """Return a livelock whose example is the first cycle that the simulation confirms. If it confirms none, the example
    is the first cycle.
    """
    bounds = graph.swarm.bounds
    chosen: tuple[_CycleExample, PlayedExample] | None = None
    for each in rounds:
        played = play({**each.document, "name": name})
        goes_round = "liveness" in played.judged
        if chosen is None or goes_round:
            chosen = each, played
        if goes_round:
            break
    assert chosen is not None, "there is a cycle"
    (begin, cycle, script, _), played = chosen
    several = PathScript(graph, [*begin, *(cycle[1:] + cycle[:1]) * ROUNDS])
    completions = () if bounds.timers_any else tuple(several.completions())
    sentence = f"The swarm can repeat a cycle for ever: {len(begin) - 1} instants after the beginning."
    said = [sentence, *([f"It does {NO_CLOCKS}."] if script.contradictory else [])]
    example = keep(played, path, bounds, len(begin) - 1 + len(cycle), said)
    known = None if bounds.timers_any else script.coincidences
    return Livelock(ways, known, completions, example, script.losses, played.cycle, script.contradictory)

"""Livelocks, each form of going round once: who, how often, what has to be the same moment, and a scenario of it.

Ways round are of one form if the same timers run in their states, whoever runs them and whatever the chains are.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from harness.archive.run_record import Cycle
from harness.proof.examples._example import Example, Played, keep, play
from harness.proof.examples._path_script import NO_CLOCKS, Completion, Document, Script
from harness.proof.graph._exploration import Graph
from harness.proof.model._global_states import AGENTS
from harness.proof.model._known_states import DEAD

MOST_FORMS = 12
"""So many forms are played: those that clocks can show before those that they cannot, and of these the nearest."""
MOST_PLAYED = 5
"""So many ways of one form are played, to find one that the simulation goes too."""
ROUNDS = 3
"""For so many rounds it is worked out how far apart what leads there may be."""

_Form = tuple[tuple[tuple[tuple[int, ...], bool], ...], ...]


@dataclass(frozen=True)
class Livelock:
    """`ways` parts of the graph go round in this form. `completions` are when blocks may be completed to come there.

    `coincidences`: so many moments have to be the same by chance on this way, to within the time that a message takes;
    another may need fewer; None if timers end in any order, which leaves that open.
    `cycle` is what the simulation was found to go round in when it played the example; None if it went another way.
    `losses`: so many messages are lost by somebody on this way. `contradictory`: ties go as no clocks make them go.
    """

    ways: int
    coincidences: int | None
    completions: tuple[Completion, ...]
    example: Example
    losses: int
    cycle: Cycle | None
    contradictory: bool = False

    def to_json(self) -> dict[str, Any]:
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
        """What it takes to get there."""
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


def forms(graph: Graph, cycles: Sequence[list[int]]) -> list[list[list[int]]]:
    """The ways round by form, the nearest first."""
    alike: dict[_Form, list[list[int]]] = defaultdict(list)
    for cycle in cycles:
        alike[_form(graph, cycle)].append(cycle)
    return list(alike.values())


def _form(graph: Graph, cycle: Sequence[int]) -> _Form:
    """The same wherever one begins to go round."""
    known = graph.swarm.local.known
    looks = [
        tuple(
            sorted(
                (known[local].running, known[local].waits) for local in graph.states[number][AGENTS:] if local != DEAD
            )
        )
        for number in cycle
    ]
    return min(tuple(looks[first:] + looks[:first]) for first in range(len(looks)))


def in_timers(graph: Graph, cycles: Sequence[list[int]]) -> list[str]:
    """Return the forms of the cycles in words: the states of a cycle, and in each state the timers of each agent."""
    names = graph.swarm.local.timers

    def agent(running: tuple[int, ...], waits: bool) -> str:
        return "+".join(names[timer] for timer in running) or ("waiting" if waits else "idle")

    def form(cycle: Sequence[int]) -> str:
        return " > ".join(", ".join(agent(*look) for look in looks) for looks in _form(graph, cycle))

    return sorted({form(cycle) for cycle in cycles})


class _Round(NamedTuple):
    """A way to where the swarm goes round, and once round, with its scenario."""

    begin: list[int]
    cycle: list[int]
    script: Script
    document: Document


def show(graph: Graph, cycles: Sequence[list[int]], path: Path, name: str) -> Iterator[Livelock]:
    """Of each form one, written to `path` and beside it."""
    by_form = [(len(alike), _nearest(graph, alike)) for alike in forms(graph, cycles)]
    by_form.sort(key=lambda form: form[1][0].script.contradictory)
    for number, (ways, rounds) in enumerate(by_form[:MOST_FORMS], 1):
        file = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
        yield _shown(graph, ways, rounds, file, name if number == 1 else f"{name} {number}")


def _nearest(graph: Graph, alike: Sequence[list[int]]) -> list[_Round]:
    """Some ways of one form: first those that clocks can show, with the fewest coincidences, and with blocks as free as
    can be."""
    tried: list[tuple[bool, int, int, _Round]] = []
    for cycle in sorted(alike, key=lambda cycle: len(graph.path(cycle[0])))[:MOST_PLAYED]:
        begin = graph.path(cycle[0])
        script = Script(graph, [*begin, *cycle[1:], cycle[0]])
        document = script.document("")
        any_time = graph.swarm.bounds.timers_any
        bound = 0 if any_time else sum(each.earliest_s == each.latest_s for each in script.completions())
        tried.append((script.contradictory, script.coincidences, bound, _Round(begin, cycle, script, document)))
    return [each for *_, each in sorted(tried, key=lambda one: one[:3])]


def _shown(graph: Graph, ways: int, rounds: Sequence[_Round], path: Path, name: str) -> Livelock:
    """The first of them that the simulation goes, too; if it goes none, the first."""
    bounds = graph.swarm.bounds
    went: tuple[_Round, Played] | None = None
    for each in rounds:
        played = play({**each.document, "name": name})
        goes_round = "liveness" in played.judged
        if went is None or goes_round:
            went = each, played
        if goes_round:
            break
    assert went is not None, "there is a way round"
    (begin, cycle, script, _), played = went
    several = Script(graph, [*begin, *(cycle[1:] + cycle[:1]) * ROUNDS])
    completions = () if bounds.timers_any else tuple(several.completions())
    sentence = f"The swarm can repeat a cycle for ever: {len(begin) - 1} instants after the beginning."
    said = [sentence, *([f"It does {NO_CLOCKS}."] if script.contradictory else [])]
    example = keep(played, path, bounds, len(begin) - 1 + len(cycle), said)
    known = None if bounds.timers_any else script.coincidences
    return Livelock(ways, known, completions, example, script.losses, played.cycle, script.contradictory)

"""A timetable as a scenario: events, datagrams, late timers and faults, word for word."""

import base64
import dataclasses
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

from harness.field.reconstruct._agent_inputs import Asked, Heard, Logged
from harness.field.reconstruct._known_mission import Mission
from harness.field.reconstruct._rehearsal import Rehearsal
from harness.field.reconstruct._timetable import APART_S, DIGITS, Happening, Life, Timetable
from harness.scenario.scenario_file import Document
from harness.scenario.strict_model import in_text
from ucp.messages import MalformedDatagramError, decode
from ucp.quirks import Quirks
from ucp.settings import Settings

MOMENT_S = APART_S / 2
Sealed = Mapping[int, Mapping[bytes, bytes]]
"""By agent, and by the event that filled the block."""
LONG_S = 0.5
"""A timer that is so late was not only waiting for its turn: its agent stood still."""


def scenario_of(
    mission: Mission, table: Timetable, rehearsals: Mapping[int, Rehearsal], lost: Collection[int], sealed: Sealed
) -> Document:
    """The scenario, as a document. An agent of the roster that was not rehearsed has no part in it.

    Those that were `lost` are switched off with the last thing on record; so is who had more to do then. `sealed` is
    what agents sealed.
    """
    lives = {agent: _lives(table.lives(agent), len(rehearsal.pending)) for agent, rehearsal in rehearsals.items()}
    strays = _Strays()
    fates = [*_fates(mission.roster, table, lives, strays)]
    entries = [*_entries(mission.roster, table, rehearsals, lives, lost)]
    last_s = max([at_s for at_s, _ in entries], default=0.0)
    last_s = max([last_s, *(happenings[-1].at_s for happenings in table.happenings.values() if happenings)])
    document: Document = {
        "name": mission.name,
        "agents": list(mission.roster),
        "duration_s": float(max(1, math.ceil(last_s + APART_S))),
        "initial_data": _base64(mission.initial_data),
        "clocks": _clocks(table),
        "settings": _settings(mission.settings),
        "quirks": _quirks({agent: rehearsal.quirks for agent, rehearsal in rehearsals.items()}),
        "timeline": _at_instants_of_their_own(entries),
        "events": {"source": "scripted", "script": _events(table, sealed)},
        "fates": fates,
        "datagrams": strays.documents(),
        "lateness": {agent: in_text(sorted(late.items()), "+") for agent, late in table.lateness.items() if late},
    }
    return {key: value for key, value in document.items() if value not in ({}, [])}


def _lives(known: Sequence[Life], count: int) -> list[Life]:
    """All lives of an agent, also those in which nothing came."""
    lives: list[Life] = []
    by_number = {life.number: life for life in known}
    for number in range(count):
        after_s = lives[-1].ended_s + 2 * APART_S if lives else 0.0
        lives.append(by_number.get(number) or Life(number, after_s, after_s, after_s, False))
    return lives


def _births(lives: Sequence[Life]) -> list[float]:
    """When each life begins: the first at 0; one that goes on from its disk with that; another before it hears."""
    births = [0.0]
    for before, life in pairwise(lives):
        births.append(life.began_s if life.boots else max(before.ended_s + APART_S, life.there_s - MOMENT_S))
    return births


def _clocks(table: Timetable) -> Document:
    clocks: Document = {}
    for agent, line in sorted(table.clocks.items()):
        drift = round(line.rate - 1, 9)
        shown = {"offset_s": line.offset_s, "drift": drift}
        if any(shown.values()):
            clocks[str(agent)] = {key: value for key, value in shown.items() if value}
    return clocks


def _settings(settings: Settings) -> Document:
    usual = dataclasses.asdict(Settings())
    return {key: value for key, value in dataclasses.asdict(settings).items() if value != usual[key]}


def _quirks(by_agent: Mapping[int, Quirks]) -> Document:
    agents: dict[str, list[int]] = defaultdict(list)
    for agent, quirks in sorted(by_agent.items()):
        for name in quirks:
            agents[name].append(agent)
    return {name: {"agents": wrong} for name, wrong in agents.items()}


def _events(table: Timetable, sealed: Sealed) -> list[Document]:
    events: list[Document] = []
    for agent, happenings in table.happenings.items():
        for happening in happenings:
            if isinstance(logged := happening.played.input.what, Logged):
                event = logged.event
                data = {"data": _base64(event.data)} if event.data.strip(b"\0") else {"bytes": len(event.data)}
                own = {"event_id": event.event_id, "timestamp_us": event.timestamp_us}
                blocks = sealed.get(agent, {}).get(event.encode())
                seal = {} if blocks is None else {"sealed": _base64(blocks)}
                events.append({"at_s": happening.at_s, "agent": agent, **own, **data, **seal})
    return sorted(events, key=lambda event: (event["at_s"], event["agent"]))


class _Strays:
    """Datagrams that are put on the air as they came."""

    def __init__(self) -> None:
        self._reached: dict[bytes, list[dict[int, float]]] = defaultdict(list)

    def add(self, datagram: bytes, receiver: int, at_s: float) -> None:
        copies = self._reached[datagram]
        copy = next((copy for copy in copies if receiver not in copy), None)
        if copy is None:
            copy = {}
            copies.append(copy)
        copy[receiver] = at_s

    def documents(self) -> list[Document]:
        documents = [
            {"source": _source(datagram), "datagram": _base64(datagram), "reaches": _with_names(copy)}
            for datagram, copies in self._reached.items()
            for copy in copies
        ]
        return sorted(documents, key=lambda document: min(document["reaches"].values()))


def _with_names(reached: Mapping[int, float]) -> Document:
    return {str(agent): at_s for agent, at_s in reached.items()}


def _source(datagram: bytes) -> int:
    """The agent that the datagram names."""
    try:
        return decode(datagram).sender
    except MalformedDatagramError:
        return 1


def _fates(
    roster: Iterable[int], table: Timetable, lives: Mapping[int, Sequence[Life]], strays: _Strays
) -> Iterator[Document]:
    """What arrived where; all else is lost. What a receiver cannot be sent is put on the air by itself."""
    arrivals: dict[tuple[int, int], list[tuple[int, float]]] = defaultdict(list)
    for receiver, happenings in table.happenings.items():
        births = _births(lives[receiver])
        for happening in happenings:
            if not isinstance(heard := happening.played.input.what, Heard):
                continue
            if _can_be_sent(happening, table, births):
                assert happening.sender is not None and happening.number is not None, "it can be sent"
                arrivals[happening.sender, receiver].append((happening.number, happening.at_s))
            else:
                strays.add(heard.datagram, receiver, happening.at_s)
    for (sender, receiver), numbered in sorted(arrivals.items()):
        yield {"sender": sender, "receiver": receiver, "arrivals": in_text(sorted(numbered), "@")}
    speak = [agent for agent, sent in table.sent.items() if sent]
    if any((sender, receiver) not in arrivals for sender in speak for receiver in roster if receiver != sender):
        yield {"drop": True}


def _can_be_sent(happening: Happening, table: Timetable, births: Sequence[float]) -> bool:
    """Not what was sent before the receiver was there to hear it."""
    if happening.sender is None or happening.number is None:
        return False
    return table.sent_at_s[happening.sender][happening.number] >= births[happening.played.life]


def _entries(
    roster: Iterable[int],
    table: Timetable,
    rehearsals: Mapping[int, Rehearsal],
    lives: Mapping[int, Sequence[Life]],
    lost: Collection[int],
) -> Iterator[tuple[float, Document]]:
    """What happened to agents, and what the operator asked."""
    yield from _pauses(table)
    if absent := [agent for agent in roster if agent not in rehearsals]:
        yield 0.0, {"kill": absent}
    for agent, happenings in table.happenings.items():
        for happening in happenings:
            if isinstance(happening.played.input.what, Asked):
                yield happening.at_s, {"reconcile": [agent]}
    for agent, rehearsal in rehearsals.items():
        births = _births(lives[agent])
        for (before, after), birth_s in zip(pairwise(lives[agent]), births[1:], strict=True):
            died_s = round(before.ended_s + MOMENT_S, DIGITS)
            if after.boots:
                yield died_s, {"reboot": [agent], "down_s": round(birth_s - died_s, 9), "disk": "kept"}
            else:
                yield died_s, {"kill": [agent]}
                yield birth_s, {"restart": [agent]}
        if agent in lost or rehearsal.parting is not None or rehearsal.broken_off or rehearsal.pending[-1]:
            yield round(lives[agent][-1].ended_s + MOMENT_S, DIGITS), {"switch_off": [agent]}


def _pauses(table: Timetable) -> Iterator[tuple[float, Document]]:
    """Who did nothing for as long as a timer was late, and that was long: it stood still."""
    for agent, happenings in table.happenings.items():
        paused: set[float] = set()
        for index, happening in enumerate(happenings):
            if happening.late_s < LONG_S:
                continue
            gaps = []
            for after, before in pairwise(reversed(happenings[: index + 1])):
                if after.at_s < happening.at_s - happening.late_s or before.played.life != happening.played.life:
                    break
                gaps.append((after.at_s - before.at_s, before.at_s, after.at_s))
            longest_s, since_s, until_s = max(gaps, default=(0.0, 0.0, 0.0))
            if longest_s > LONG_S / 2 and since_s not in paused:
                paused.add(since_s)
                yield round(since_s + MOMENT_S, DIGITS), {"pause": [agent]}
                yield round(until_s - MOMENT_S, DIGITS), {"resume": [agent]}


def _at_instants_of_their_own(entries: Iterable[tuple[float, Document]]) -> list[Document]:
    taken: set[float] = set()
    timeline = []
    for at_s, entry in sorted(entries, key=lambda timed: timed[0]):
        at_s = round(at_s, DIGITS)
        while at_s in taken:
            at_s = round(at_s + 10**-DIGITS, DIGITS)
        taken.add(at_s)
        timeline.append({"at_s": at_s, **entry})
    return timeline


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")

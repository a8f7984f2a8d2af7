"""Write the inputs of all agents as a scenario with exact events, datagrams, timer delays and faults."""

import base64
import dataclasses
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

from harness.checker.reference.state import Settings
from harness.field.reconstruct._agent_inputs import DatagramReceived, EventLogged, ReconcileRequested
from harness.field.reconstruct._known_mission import MissionConfiguration
from harness.field.reconstruct._rehearsal import SoloSimulation
from harness.field.reconstruct._timetable import DIGITS, MIN_GAP_S, IncarnationTimes, InputTimetable, TimedInput
from harness.scenario.scenario_file import Document
from harness.scenario.strict_model import format_pairs
from ucp.messages import MalformedDatagramError, decode
from ucp.quirks import Quirks

HALF_GAP_S = MIN_GAP_S / 2
Sealed = Mapping[int, Mapping[bytes, bytes]]
"""The encrypted event data of each block. The first key is the agent ID, and the second is the event that filled the
block, encoded as bytes.
"""
MIN_PAUSE_S = 0.5
"""If a timer is delayed by at least this number of seconds, the agent is assumed to have been paused."""


def scenario_document(
    mission: MissionConfiguration,
    table: InputTimetable,
    rehearsals: Mapping[int, SoloSimulation],
    lost: Collection[int],
    sealed: Sealed,
) -> Document:
    """Return the scenario as a document. An agent without simulated inputs is not in the scenario.

    The agents in `lost`, and agents whose record ends early, are switched off after their last input. `sealed` contains
    encrypted event data.
    """
    incarnations = {
        agent: _all_incarnations(table.incarnations(agent), len(rehearsal.running_at_end))
        for agent, rehearsal in rehearsals.items()
    }
    strays = _StrayDatagrams()
    fates = [*_fates(mission.roster, table, incarnations, strays)]
    entries = [*_entries(mission.roster, table, rehearsals, incarnations, lost)]
    last_s = max([at_s for at_s, _ in entries], default=0.0)
    last_s = max([last_s, *(inputs[-1].at_s for inputs in table.inputs.values() if inputs)])
    document: Document = {
        "name": mission.name,
        "agents": list(mission.roster),
        "duration_s": float(max(1, math.ceil(last_s + MIN_GAP_S))),
        "initial_data": _base64(mission.initial_data),
        "clocks": _clocks(table),
        # The fates have the time at which each answer arrives, so answers need not wait.
        "settings": _settings(dataclasses.replace(mission.settings, answer_spread_s=0.0)),
        "quirks": _quirks({agent: rehearsal.quirks for agent, rehearsal in rehearsals.items()}),
        "timeline": _with_unique_times(entries),
        "events": {"source": "scripted", "script": _events(table, sealed)},
        "fates": fates,
        "datagrams": strays.documents(),
        "lateness": {agent: format_pairs(sorted(late.items()), "+") for agent, late in table.lateness.items() if late},
    }
    return {key: value for key, value in document.items() if value not in ({}, [])}


def _all_incarnations(known: Sequence[IncarnationTimes], count: int) -> list[IncarnationTimes]:
    """Return the times of all incarnations of an agent, including the incarnations without inputs."""
    incarnations: list[IncarnationTimes] = []
    by_number = {incarnation.number: incarnation for incarnation in known}
    for number in range(count):
        after_s = incarnations[-1].ended_s + 2 * MIN_GAP_S if incarnations else 0.0
        incarnations.append(by_number.get(number) or IncarnationTimes(number, after_s, after_s, after_s, False))
    return incarnations


def _start_times(incarnations: Sequence[IncarnationTimes]) -> list[float]:
    """Return the start times of an agent's incarnations. The first incarnation starts at 0. Later incarnations start at
    the recorded restart, or just before their first reception.
    """
    start_times = [0.0]
    for before, incarnation in pairwise(incarnations):
        start_times.append(
            incarnation.began_s
            if incarnation.boots
            else max(before.ended_s + MIN_GAP_S, incarnation.present_s - HALF_GAP_S)
        )
    return start_times


def _clocks(table: InputTimetable) -> Document:
    clocks: Document = {}
    for agent, line in sorted(table.clocks.items()):
        drift = round(line.rate - 1, 9)
        shown = {"offset_s": line.offset_s, "drift": drift}
        if any(shown.values()):
            clocks[str(agent)] = {key: value for key, value in shown.items() if value}
    return clocks


def _settings(settings: Settings) -> Document:
    default = dataclasses.asdict(Settings())
    return {key: value for key, value in dataclasses.asdict(settings).items() if value != default[key]}


def _quirks(by_agent: Mapping[int, Quirks]) -> Document:
    agents: dict[str, list[int]] = defaultdict(list)
    for agent, quirks in sorted(by_agent.items()):
        for name in quirks:
            agents[name].append(agent)
    return {name: {"agents": wrong} for name, wrong in agents.items()}


def _events(table: InputTimetable, sealed: Sealed) -> list[Document]:
    events: list[Document] = []
    for agent, inputs in table.inputs.items():
        for timed_input in inputs:
            if isinstance(logged := timed_input.played.input.cause, EventLogged):
                event = logged.event
                data = {"data": _base64(event.data)} if event.data.strip(b"\0") else {"bytes": len(event.data)}
                own = {"event_id": event.event_id, "timestamp_us": event.timestamp_us}
                blocks = sealed.get(agent, {}).get(event.encode())
                seal = {} if blocks is None else {"sealed": _base64(blocks)}
                events.append({"at_s": timed_input.at_s, "agent": agent, **own, **data, **seal})
    return sorted(events, key=lambda event: (event["at_s"], event["agent"]))


class _StrayDatagrams:
    """Datagrams that no agent in the scenario sends. The scenario contains entries that send these datagrams."""

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
            {"source": _source(datagram), "datagram": _base64(datagram), "reaches": _with_text_keys(copy)}
            for datagram, copies in self._reached.items()
            for copy in copies
        ]
        return sorted(documents, key=lambda document: min(document["reaches"].values()))


def _with_text_keys(reached: Mapping[int, float]) -> Document:
    return {str(agent): at_s for agent, at_s in reached.items()}


def _source(datagram: bytes) -> int:
    """Return the agent ID in the sender field of the datagram."""
    try:
        return decode(datagram).sender
    except MalformedDatagramError:
        return 1


def _fates(
    roster: Iterable[int],
    table: InputTimetable,
    incarnations: Mapping[int, Sequence[IncarnationTimes]],
    strays: _StrayDatagrams,
) -> Iterator[Document]:
    """Yield the scripted delivery of each datagram that arrives. All other datagrams are lost. If no agent can send a
    datagram to its receiver, the datagram becomes a *stray*, which the scenario itself delivers.
    """
    arrivals: dict[tuple[int, int], list[tuple[int, float]]] = defaultdict(list)
    for receiver, inputs in table.inputs.items():
        start_times = _start_times(incarnations[receiver])
        for timed_input in inputs:
            if not isinstance(received := timed_input.played.input.cause, DatagramReceived):
                continue
            if _can_be_sent(timed_input, table, start_times):
                assert timed_input.sender is not None and timed_input.number is not None, "it can be sent"
                arrivals[timed_input.sender, receiver].append((timed_input.number, timed_input.at_s))
            else:
                strays.add(received.datagram, receiver, timed_input.at_s)
    for (sender, receiver), numbered in sorted(arrivals.items()):
        yield {"sender": sender, "receiver": receiver, "arrivals": format_pairs(sorted(numbered), "@")}
    senders = [agent for agent, sent in table.sent.items() if sent]
    if any((sender, receiver) not in arrivals for sender in senders for receiver in roster if receiver != sender):
        yield {"drop": True}


def _can_be_sent(timed_input: TimedInput, table: InputTimetable, start_times: Sequence[float]) -> bool:
    """Return true if a simulated agent sent the datagram when the receiver was already running."""
    if timed_input.sender is None or timed_input.number is None:
        return False
    return table.sent_at_s[timed_input.sender][timed_input.number] >= start_times[timed_input.played.incarnation]


def _entries(
    roster: Iterable[int],
    table: InputTimetable,
    rehearsals: Mapping[int, SoloSimulation],
    incarnations: Mapping[int, Sequence[IncarnationTimes]],
    lost: Collection[int],
) -> Iterator[tuple[float, Document]]:
    """Yield the timeline entries of the scenario: faults of agents, and commands of the operator."""
    yield from _pauses(table)
    if absent := [agent for agent in roster if agent not in rehearsals]:
        yield 0.0, {"kill": absent}
    for agent, inputs in table.inputs.items():
        for timed_input in inputs:
            if isinstance(timed_input.played.input.cause, ReconcileRequested):
                yield timed_input.at_s, {"reconcile": [agent]}
    for agent, rehearsal in rehearsals.items():
        start_times = _start_times(incarnations[agent])
        for (before, after), start_s in zip(pairwise(incarnations[agent]), start_times[1:], strict=True):
            end_s = round(before.ended_s + HALF_GAP_S, DIGITS)
            if after.boots:
                yield end_s, {"reboot": [agent], "down_s": round(start_s - end_s, 9), "disk": "kept"}
            else:
                yield end_s, {"kill": [agent]}
                yield start_s, {"restart": [agent]}
        if agent in lost or rehearsal.deviation is not None or rehearsal.truncated or rehearsal.running_at_end[-1]:
            yield round(incarnations[agent][-1].ended_s + HALF_GAP_S, DIGITS), {"switch_off": [agent]}


def _pauses(table: InputTimetable) -> Iterator[tuple[float, Document]]:
    """Yield a pause for each time that an agent did nothing although a timer was long overdue."""
    for agent, inputs in table.inputs.items():
        pause_starts: set[float] = set()
        for index, timed_input in enumerate(inputs):
            if timed_input.late_s < MIN_PAUSE_S:
                continue
            gaps = []
            for after, before in pairwise(reversed(inputs[: index + 1])):
                if (
                    after.at_s < timed_input.at_s - timed_input.late_s
                    or before.played.incarnation != timed_input.played.incarnation
                ):
                    break
                gaps.append((after.at_s - before.at_s, before.at_s, after.at_s))
            longest_s, since_s, until_s = max(gaps, default=(0.0, 0.0, 0.0))
            if longest_s > MIN_PAUSE_S / 2 and since_s not in pause_starts:
                pause_starts.add(since_s)
                yield round(since_s + HALF_GAP_S, DIGITS), {"pause": [agent]}
                yield round(until_s - HALF_GAP_S, DIGITS), {"resume": [agent]}


def _with_unique_times(entries: Iterable[tuple[float, Document]]) -> list[Document]:
    used: set[float] = set()
    timeline = []
    for at_s, entry in sorted(entries, key=lambda timed: timed[0]):
        at_s = round(at_s, DIGITS)
        while at_s in used:
            at_s = round(at_s + 10**-DIGITS, DIGITS)
        used.add(at_s)
        timeline.append({"at_s": at_s, **entry})
    return timeline


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")

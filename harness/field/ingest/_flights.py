"""Puts together what is of one flight: the same mission, on the same clock, every agent once.

A mission is its roster and what its inception block says (BD_0). Of one mission there may be several flights, each with
its own second 0. Exports and captures do not say which: they go where the blocks are that they name.
"""

import base64
import binascii
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from harness.archive.exports import Export
from harness.archive.traces import Header, Trace
from harness.field.ingest._copies import told_apart
from harness.field.ingest._file_owners import Glance
from harness.field.ingest._ingest import Flight, LeftOut, Remark
from harness.field.ingest._trace_incarnations import Life
from ucp.block import InceptionBlock
from ucp.events import LoggableEvent


class _Mission(NamedTuple):
    """As a header says it: BD_0 in base64, if it does, and mission second 0."""

    initial_data: str | None
    roster: tuple[int, ...]
    epoch_us: int | None


@dataclass
class _Gathering:
    """A flight while it is put together. `hashes` are of its blocks and chains, in hex."""

    mission: _Mission
    lives: dict[int, list[Life]] = field(default_factory=lambda: defaultdict(list))
    exports: dict[int, tuple[Path, Export]] = field(default_factory=dict)
    captures: dict[int, Path] = field(default_factory=dict)
    more_captures: list[Path] = field(default_factory=list)
    logged: dict[int, list[LoggableEvent]] = field(default_factory=lambda: defaultdict(list))
    hashes: set[str] = field(default_factory=set)
    directories: set[Path] = field(default_factory=set)

    def add(self, life: Life, agent_id: int) -> None:
        self.lives[agent_id].append(life)
        self.directories.add(life.path.parent)
        self.hashes |= _hashes_of(life)

    @property
    def runs(self) -> int:
        return sum(len(life.runs) for lives in self.lives.values() for life in lives)

    @property
    def size(self) -> tuple[int, int]:
        return len(self.lives) + len(self.exports) + len(self.captures) + len(self.logged), self.runs

    @cached_property
    def spans(self) -> tuple[float, float]:
        """From when to when its handlers ran, in the seconds of its blocks' timestamps."""
        times = [run.t for lives in self.lives.values() for life in lives for run in life.runs]
        begins = (self.mission.epoch_us or 0) / 1e6
        return begins + min(times, default=0.0), begins + max(times, default=0.0)


def put_together(
    lives: Iterable[Life],
    exports: Iterable[tuple[Path, Export]],
    captures: Iterable[Glance],
    logged: Iterable[tuple[Path, int, LoggableEvent]],
    left_out: list[LeftOut],
    remarks: list[Remark],
) -> list[Flight]:
    """The flights, the one with the most in it first."""
    gatherings, headless = _by_mission(lives, left_out)
    for path, export in exports:
        _add_export(gatherings, path, export, left_out)
    for life in headless:
        _add_headless(gatherings, life, left_out, remarks)
    for capture in captures:
        _add_capture(gatherings, capture)
    for path, agent_id, event in logged:
        _add_logged(gatherings, path, agent_id, event)
    gatherings.sort(key=lambda gathering: gathering.size, reverse=True)
    return [_flight(gathering, remarks) for gathering in gatherings]


# Traces


def _by_mission(lives: Iterable[Life], left_out: list[LeftOut]) -> tuple[list[_Gathering], list[Life]]:
    """What is of each mission and second 0, and the lives of which the header is lost."""
    by_header: dict[tuple[_Mission, int], list[Life]] = defaultdict(list)
    headless: list[Life] = []
    last: Life | None = None
    for life in lives:
        if life.header is None and last is not None and last.path == life.path and last.agent_id == life.agent_id:
            life.header = last.header  # an agent that was restarted, and only the line that says so is damaged
        if life.header is None:
            headless.append(life)
        elif life.header.agent_id not in life.header.roster:
            why = f"agent {life.header.agent_id} is not on the roster in its own trace"
            left_out.append(LeftOut(life.path, why, life.first_line, life.counts))
        else:
            by_header[_mission_of(life.header), life.header.agent_id].append(life)
        last = life
    gatherings: dict[_Mission, list[_Gathering]] = defaultdict(list)
    for (mission, agent_id), of_agent in by_header.items():
        _place(gatherings[mission], mission, agent_id, [*told_apart(of_agent, left_out)])
    separate = [gathering for of_mission in gatherings.values() for gathering in of_mission]
    return _merged(separate), headless


def _mission_of(header: Header) -> _Mission:
    epoch: object = header.clock.get("epoch_us")
    if not isinstance(epoch, int) or isinstance(epoch, bool) or not 0 <= epoch < 2**63:
        epoch = None
    return _Mission(header.initial_data, tuple(sorted(set(header.roster))), epoch)


def _place(gatherings: list[_Gathering], mission: _Mission, agent_id: int, flights: list[list[Life]]) -> None:
    """An agent's flights go where the others' files are beside its own, of flights that nothing else tells apart."""

    def beside(flown: list[Life], gathering: _Gathering) -> int:
        return len(gathering.directories & {life.path.parent for life in flown})

    flights.sort(key=lambda flown: max((beside(flown, each) for each in gatherings), default=0), reverse=True)
    for flown in flights:
        free = [gathering for gathering in gatherings if agent_id not in gathering.lives]
        best = max(free, key=lambda gathering: beside(flown, gathering), default=None)
        if best is None:
            best = _Gathering(mission)
            gatherings.append(best)
        for life in flown:
            best.add(life, agent_id)


def _merged(gatherings: list[_Gathering]) -> list[_Gathering]:
    """Agents with a second 0 of their own, or that do not say BD_0, join the others if those lack them."""
    merged: list[_Gathering] = []
    for gathering in sorted(gatherings, key=lambda each: each.size, reverse=True):
        host = next((other for other in merged if _same_flight(gathering, other)), None)
        if host is None:
            merged.append(gathering)
            continue
        for agent_id, lives in gathering.lives.items():
            host.lives[agent_id] = lives
        host.hashes |= gathering.hashes
        host.__dict__.pop("spans", None)
        host.directories |= gathering.directories
        if host.mission.initial_data is None or host.mission.epoch_us is None:
            host.mission = host.mission._replace(
                initial_data=host.mission.initial_data or gathering.mission.initial_data,
                epoch_us=gathering.mission.epoch_us if host.mission.epoch_us is None else host.mission.epoch_us,
            )
    return merged


def _same_flight(gathering: _Gathering, other: _Gathering) -> bool:
    mine, its = gathering.mission, other.mission
    if gathering.lives.keys() & other.lives.keys():
        return False
    if gathering.hashes & other.hashes:
        return True  # whatever a damaged header says
    if mine.roster != its.roster:
        return False
    if mine.initial_data != its.initial_data and None not in (mine.initial_data, its.initial_data):
        return False
    if None in (mine.epoch_us, its.epoch_us):
        return True
    (begins, ends), (its_begins, its_ends) = gathering.spans, other.spans
    return begins <= its_ends and its_begins <= ends


def _hashes_of(life: Life) -> set[str]:
    hashes = {block for run in life.runs for _, block in run.changes}
    hashes.update(run.state.top for run in life.runs if run.state.chain)  # the inception block is that of every flight
    return hashes


def _add_headless(gatherings: list[_Gathering], life: Life, left_out: list[LeftOut], remarks: list[Remark]) -> None:
    """A life whose header is lost is under that of the others of its flight, whose mission it shares."""
    agent_id, hashes = life.agent_id, _hashes_of(life)
    if agent_id is None or not life.runs:
        left_out.append(LeftOut(life.path, "its header is lost, so its agent is unknown"))
        return
    able = [gathering for gathering in gatherings if agent_id in gathering.mission.roster and gathering.lives]
    likeliest = max(
        able,
        key=lambda each: (len(each.hashes & hashes), life.path.parent in each.directories, each.size),
        default=None,
    )
    if likeliest is None or not (likeliest.hashes & hashes or life.path.parent in likeliest.directories):
        why = f"its header is lost, and no other trace belongs to a mission of agent {agent_id}"
        left_out.append(LeftOut(life.path, why))
        return
    own = likeliest.lives.get(agent_id, [])
    lender = next(iter(own or next(iter(likeliest.lives.values()))))
    assert lender.header is not None
    clock = lender.header.clock
    if not own:
        clock = {key: clock[key] for key in ("epoch_us", "speedup") if key in clock}
    life.header = lender.header.model_copy(update={"agent_id": agent_id, "clock": clock})
    kept = next(told_apart([*own, life], left_out))
    if life in kept:
        whose = "another of its files" if own else f"the trace of agent {lender.header.agent_id}"
        remarks.append(
            Remark(
                life.path, f"its header is lost; it is read as a trace of agent {agent_id}, with the header of {whose}"
            )
        )
    likeliest.lives[agent_id] = kept
    likeliest.hashes |= hashes


# Exports and captures


def _add_export(gatherings: list[_Gathering], path: Path, export: Export, left_out: list[LeftOut]) -> None:
    agent_id, inception = export.agent_id, export.inception
    hashes = {block.block_hash for block in export.blocks()} | {*export.completed}
    of_mission = [
        gathering
        for gathering in gatherings
        if gathering.mission.initial_data in (None, inception.block_data)
        and (not gathering.exports or _inception(gathering) == inception.block_hash)
    ]
    able = [each for each in of_mission if not each.mission.roster or agent_id in each.mission.roster]
    if of_mission and not able:
        left_out.append(LeftOut(path, f"agent {agent_id} is not on the roster of its mission"))
        return
    likeliest = max(
        able,
        key=lambda each: (
            len(each.hashes & hashes),
            path.parent in each.directories,
            each.mission.initial_data is not None,
            each.size,
        ),
        default=None,
    )
    if likeliest is not None and likeliest.mission.initial_data is None and not likeliest.hashes & hashes:
        likeliest = None if likeliest.hashes and hashes else likeliest
    if likeliest is None:
        likeliest = _Gathering(_Mission(inception.block_data, (), None))
        gatherings.append(likeliest)
    likeliest.hashes |= hashes | {block.chain_hash for block in export.chain if block.chain_hash}
    likeliest.directories.add(path.parent)
    likeliest.mission = likeliest.mission._replace(initial_data=inception.block_data)
    other = likeliest.exports.get(agent_id)
    if other is None:
        likeliest.exports[agent_id] = path, export
        return
    if other[1] == export:
        left_out.append(LeftOut(path, f"it is the same export as {other[0]}"))
        return
    earlier, later = sorted((other, (path, export)), key=lambda each: each[1].exported_at_us)
    likeliest.exports[agent_id] = later
    left_out.append(LeftOut(earlier[0], f"agent {agent_id} exported its chain again, later: {later[0]} is used"))


def _inception(gathering: _Gathering) -> str:
    return next(iter(gathering.exports.values()))[1].inception.block_hash


def _inception_chain_hash(gathering: _Gathering) -> str | None:
    """CH_0 (eq. 3.4), which every flight of the mission has."""
    data = _decoded(gathering.mission.initial_data)
    return None if data is None else InceptionBlock(data).chain_hash.hex()


def _add_capture(gatherings: list[_Gathering], capture: Glance) -> None:
    of_inceptions = {_inception_chain_hash(gathering) for gathering in gatherings}

    def shared(gathering: _Gathering) -> int:
        return len((gathering.hashes & capture.hashes) - of_inceptions)

    def same_mission(gathering: _Gathering) -> bool:
        return _inception_chain_hash(gathering) in capture.hashes

    able = [each for each in gatherings if shared(each) or same_mission(each) or not each.hashes or not capture.hashes]
    likeliest = max(
        able,
        key=lambda each: (
            shared(each),
            same_mission(each),
            capture.epoch_us is not None and capture.epoch_us == each.mission.epoch_us,
            capture.source.parent in each.directories,
            each.size,
        ),
        default=None,
    )
    if likeliest is None:
        likeliest = _Gathering(_Mission(None, (), capture.epoch_us))
        gatherings.append(likeliest)
    likeliest.hashes |= capture.hashes
    likeliest.directories.add(capture.source.parent)
    if likeliest.mission.epoch_us is None:
        likeliest.mission = likeliest.mission._replace(epoch_us=capture.epoch_us)
    if capture.vehicle is None or capture.vehicle in likeliest.captures:
        likeliest.more_captures.append(capture.path)
    else:
        likeliest.captures[capture.vehicle] = capture.path


def _add_logged(gatherings: list[_Gathering], path: Path, agent_id: int, event: LoggableEvent) -> None:
    """An event is of the flight that was under way then, else of the one whose files lie beside."""

    def under_way(gathering: _Gathering) -> bool:
        begins, ends = gathering.spans
        return begins <= event.timestamp_us / 1e6 <= ends

    able = [each for each in gatherings if not each.mission.roster or agent_id in each.mission.roster]
    likeliest = max(able, key=lambda each: (under_way(each), path.parent in each.directories, each.size), default=None)
    if likeliest is None:
        likeliest = _Gathering(_Mission(None, (), None))
        gatherings.append(likeliest)
    likeliest.logged[agent_id].append(event)


# What comes out


def _flight(gathering: _Gathering, remarks: list[Remark]) -> Flight:
    traces = {agent_id: _trace(lives) for agent_id, lives in sorted(gathering.lives.items())}
    for agent_id, trace in traces.items():
        remarks += _clock_remarks(agent_id, gathering.lives[agent_id], trace)
    return Flight(
        _decoded(gathering.mission.initial_data),
        traces,
        {agent_id: export for agent_id, (_, export) in sorted(gathering.exports.items())},
        dict(sorted(gathering.captures.items())),
        gathering.mission.roster,
        gathering.mission.epoch_us,
        gathering.more_captures,
        {agent_id: sorted(events, key=attrgetter("timestamp_us")) for agent_id, events in gathering.logged.items()},
        {agent_id: list(dict.fromkeys(life.path for life in lives)) for agent_id, lives in gathering.lives.items()},
    )


def _trace(lives: list[Life]) -> Trace:
    header = lives[0].header
    assert header is not None
    trace, run_lines, aside_lines = Trace(header), list[int](), list[int]()
    for number, life in enumerate(lives):
        begun = len(trace.runs)
        if number:
            trace.starts.append(begun)
        trace.runs += life.runs
        trace.asides += [(begun + position, aside) for position, aside in life.asides]
        trace.gaps += [gap._replace(position=begun + gap.position) for gap in life.gaps]
        trace.jumps += [begun + position for position in life.jumps]
        run_lines += life.run_lines
        aside_lines += life.aside_lines
    trace.lines = run_lines, aside_lines
    trace.cut_off = lives[-1].cut_off
    return trace


def _clock_remarks(agent_id: int, lives: list[Life], trace: Trace) -> Iterator[Remark]:
    jumps = [(life, position) for life in lives for position in life.jumps]
    for life, position in jumps[:1]:
        before, after = life.runs[position - 1].t, life.runs[position].t
        more = f", and {len(jumps) - 1} more times" if len(jumps) > 1 else ""
        yield Remark(
            life.path,
            f"the clock of agent {agent_id} jumps from {before:.3f} s to {after:.3f} s here{more}",
            life.run_lines[position],
            life.counts,
        )


def _decoded(initial_data: str | None) -> bytes | None:
    try:
        return None if initial_data is None else base64.b64decode(initial_data, validate=True)
    except (binascii.Error, ValueError):
        return None

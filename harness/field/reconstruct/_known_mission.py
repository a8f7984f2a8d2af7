"""The mission and settings of a flight: recorded, or inferred from what agents sent.

Some show in messages: a vote that names a chain, and how full blocks are. Of the others each is tried by itself.
"""

import base64
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial

from harness.archive.traces import Header
from harness.checker.judgement import agents
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import FieldError
from harness.field.ingest import Flight
from harness.field.reconstruct._inferring import infer
from harness.field.reconstruct._other_records import Captured, Elsewhere
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import BlockAddResponse, decode
from ucp.settings import CHOICES, Settings

TRIES = 10
"""Orders of what one agent received that are tried with one reading."""


def likely(
    elsewhere: Elsewhere, captured: dict[int, Captured], header_of: Callable[[int, Settings], CheckedHeader]
) -> Settings:
    """The settings that explain the most of what the captured agents sent."""
    events = {agent_id: elsewhere.events(agent_id) for agent_id in captured}

    def explained(settings: Settings) -> tuple[int, int]:
        """How many agents, and how many of their inputs."""
        inferred = [
            infer(header_of(agent_id, settings), seen, events[agent_id], tries=TRIES)
            for agent_id, seen in captured.items()
        ]
        return sum(one.problem is None for one in inferred), sum(one.explained for one in inferred)

    seen = _seen(elsewhere)
    best, most = seen, explained(seen)
    for settings in _others(seen):
        if most[0] == len(captured):
            break
        if (more := explained(settings)) > most:
            best, most = settings, more
    return best


SHOWN_BY_VOTES = "vote_names_chain"
"""The setting that `_seen` reads from the votes."""


def _others(seen: Settings) -> Iterator[Settings]:
    for name, choice in reversed(CHOICES.items()):
        if choice.is_reading and name != SHOWN_BY_VOTES:
            for value in choice.values[1:]:
                yield replace(seen, **{name: value})  # type: ignore[arg-type]  # each setting takes its own values
    yield replace(seen, finalize_gap_s=0.0)


def _seen(elsewhere: Elsewhere) -> Settings:
    """What messages and blocks show."""
    votes = (decode(datagram).message for datagram in elsewhere.all_datagrams())
    names_chain = any(isinstance(vote, BlockAddResponse) and vote.chain_hash is not None for vote in votes)
    usual = Settings()
    return replace(
        usual,
        vote_names_chain=names_chain,
        max_block_bytes=_fullness(elsewhere.event_data(), usual.max_event_bytes),
    )


def _fullness(blocks: Iterable[bytes], largest: int) -> int:
    """max_block_bytes: a block is full as soon as another event of the largest size might not fit."""
    least, most = largest, MAX_EVENT_DATA_BYTES
    for event_data in blocks:
        last = _last_event_bytes(event_data)
        if last is not None:
            least = max(least, len(event_data) - last + largest + 1)
            most = min(most, len(event_data) + largest)
    usual = Settings().max_block_bytes
    return usual if least <= usual <= most or least > most else most


def _last_event_bytes(event_data: bytes) -> int | None:
    try:
        events = decode_events(event_data)
    except MalformedEventsError:
        return None
    return events[-1].encoded_bytes if events else None


NOTHING = "the records hold no inputs of agents: add traces (*.trace.jsonl), or captures together with exports"


@dataclass(frozen=True)
class Mission:
    """What all agents of a flight were told."""

    name: str
    roster: tuple[int, ...]
    initial_data: bytes
    settings: Settings


def told(
    flight: Flight, elsewhere: Elsewhere, name: str, remarks: list[str]
) -> tuple[Mission, dict[int, CheckedHeader]]:
    """The mission, and what each agent was told of which enough is on record. Raises FieldError if of none."""
    initial_data = _initial_data(flight)
    headers: dict[int, CheckedHeader] = {}
    for agent_id, trace in sorted(flight.traces.items()):
        header = trace.header
        if header.initial_data is None and initial_data is not None:
            header = header.model_copy(update={"initial_data": initial_data})
        try:
            headers[agent_id] = elsewhere.with_seal(checked(header))
        except ImpossibleHeaderError as error:
            remarks.append(f"agent {agent_id}: {error}")
    roster = {*flight.roster, *flight.agents, *(member for header in headers.values() for member in header.roster)}
    roster |= {*elsewhere.senders()}
    common = Counter(header.settings for header in headers.values()).most_common(1)
    untraced = sorted({*elsewhere.captured} & {*flight.exports} - {*headers})
    if untraced and initial_data is not None:
        whole = partial(_assumed, elsewhere, roster=roster, initial_data=initial_data)
        captured = {agent_id: elsewhere.captured[agent_id] for agent_id in untraced}
        settings = common[0][0] if common else likely(elsewhere, captured, whole)
        headers |= {agent_id: whole(agent_id, settings) for agent_id in untraced}
        whose = "as the others'" if common else f"the best fit to the records: {_in_words(settings)}"
        remarks.append(f"settings of {agents(untraced)} are not recorded; assumed: {whose}")
    settings = Counter(header.settings for header in headers.values()).most_common(1)[0][0] if headers else Settings()
    if not headers:
        raise FieldError("; ".join([*elsewhere.problems[:1], NOTHING]))
    of_all = Counter(header.initial_data for header in headers.values()).most_common(1)[0][0]
    data = of_all if initial_data is None else base64.b64decode(initial_data)
    return Mission(name, tuple(sorted(roster)), data, settings), headers


def _in_words(settings: Settings) -> str:
    usual = asdict(Settings())
    unusual = [f"{name} {value}" for name, value in asdict(settings).items() if value != usual[name]]
    return ", ".join(unusual) or "the thesis's"


def _initial_data(flight: Flight) -> str | None:
    """In base64."""
    if flight.initial_data is not None:
        return base64.b64encode(flight.initial_data).decode("ascii")
    return next((export.inception.block_data for export in flight.exports.values()), None)


def _assumed(
    elsewhere: Elsewhere, agent_id: int, settings: Settings, *, roster: Iterable[int], initial_data: str
) -> CheckedHeader:
    header = Header(agent_id=agent_id, roster=sorted(roster), settings={}, clock={}, initial_data=initial_data)
    return elsewhere.with_seal(replace(checked(header), settings=settings))

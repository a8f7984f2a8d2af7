"""Find the mission and the settings of a flight. If no record contains them, they are guessed from the sent messages.

Messages and blocks reveal some settings: whether votes name a chain, and the size of a full block. For each other
setting, every value is tried, and the value that explains the most messages is assumed.
"""

import base64
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial

from harness.archive.traces import TraceHeader
from harness.checker.judgement import agents
from harness.checker.reference.state import Settings
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import FieldError
from harness.field._vehicle_captures import AgentCapture
from harness.field.ingest import Flight
from harness.field.reconstruct._inferring import infer
from harness.field.reconstruct._other_records import OtherRecords
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import BlockAddResponse, decode
from ucp.settings import CHOICES

TRIES = 10
"""Maximum number of input orders that are tried for one agent with one combination of settings."""


def likely_settings(
    other_records: OtherRecords, captures: dict[int, AgentCapture], header_of: Callable[[int, Settings], CheckedHeader]
) -> Settings:
    """Return the settings with which the packet captures explain the most agents completely."""
    events = {agent_id: other_records.events(agent_id) for agent_id in captures}

    def explained(settings: Settings) -> tuple[int, int]:
        """Return two numbers for these settings: the number of agents whose inputs are completely explained, and the
        number of explained inputs of all agents.
        """
        inferred = [
            infer(header_of(agent_id, settings), capture, events[agent_id], tries=TRIES)
            for agent_id, capture in captures.items()
        ]
        return sum(one.problem is None for one in inferred), sum(one.explained for one in inferred)

    visible = _visible_settings(other_records)
    best, most = visible, explained(visible)
    for settings in _alternatives(visible):
        if most[0] == len(captures):
            break
        if (score := explained(settings)) > most:
            best, most = settings, score
    return best


SHOWN_BY_VOTES = "vote_names_chain"
"""The setting that the votes reveal."""


def _alternatives(visible: Settings) -> Iterator[Settings]:
    for name, choice in reversed(CHOICES.items()):
        if choice.is_reading and name != SHOWN_BY_VOTES:
            for value in choice.values[1:]:
                yield replace(visible, **{name: value})  # type: ignore[arg-type]  # each setting takes its own values
    yield replace(visible, finalize_gap_s=0.0)


def _visible_settings(other_records: OtherRecords) -> Settings:
    """Return the settings that messages and blocks reveal."""
    votes = (decode(datagram).message for datagram in other_records.all_datagrams())
    names_chain = any(isinstance(vote, BlockAddResponse) and vote.chain_hash is not None for vote in votes)
    default = Settings()
    return replace(
        default,
        vote_names_chain=names_chain,
        max_block_bytes=_max_block_bytes(other_records.event_data(), default.max_event_bytes),
    )


def _max_block_bytes(blocks: Iterable[bytes], largest: int) -> int:
    """Return the setting max_block_bytes, which is computed from the sizes of the blocks. A block is full if an event
    of the largest size might not fit into it.
    """
    least, most = largest, MAX_EVENT_DATA_BYTES
    for event_data in blocks:
        last = _last_event_bytes(event_data)
        if last is not None:
            least = max(least, len(event_data) - last + largest + 1)
            most = min(most, len(event_data) + largest)
    default = Settings().max_block_bytes
    return default if least <= default <= most or least > most else most


def _last_event_bytes(event_data: bytes) -> int | None:
    try:
        events = decode_events(event_data)
    except MalformedEventsError:
        return None
    return events[-1].encoded_bytes if events else None


NO_INPUTS = "the records hold no inputs of agents: add traces (*.trace.jsonl), or captures together with exports"


@dataclass(frozen=True)
class MissionConfiguration:
    """The configuration that all agents of a flight share."""

    name: str
    roster: tuple[int, ...]
    initial_data: bytes
    settings: Settings


def known_mission(
    flight: Flight, other_records: OtherRecords, name: str, remarks: list[str]
) -> tuple[MissionConfiguration, dict[int, CheckedHeader]]:
    """Return the mission, and the trace header of each agent that has enough records to be simulated.

    Raises FieldError if no agent has enough records.
    """
    initial_data = _initial_data(flight)
    headers: dict[int, CheckedHeader] = {}
    for agent_id, trace in sorted(flight.traces.items()):
        header = trace.header
        if header.initial_data is None and initial_data is not None:
            header = header.model_copy(update={"initial_data": initial_data})
        try:
            headers[agent_id] = other_records.with_seal(checked(header))
        except ImpossibleHeaderError as error:
            remarks.append(f"agent {agent_id}: {error}")
    roster = {*flight.roster, *flight.agents, *(member for header in headers.values() for member in header.roster)}
    roster |= {*other_records.senders()}
    common = Counter(header.settings for header in headers.values()).most_common(1)
    untraced = sorted({*other_records.captures} & {*flight.exports} - {*headers})
    if untraced and initial_data is not None:
        header_of_agent = partial(_assumed, other_records, roster=roster, initial_data=initial_data)
        captures = {agent_id: other_records.captures[agent_id] for agent_id in untraced}
        settings = common[0][0] if common else likely_settings(other_records, captures, header_of_agent)
        headers |= {agent_id: header_of_agent(agent_id, settings) for agent_id in untraced}
        source = "as the others'" if common else f"the best fit to the records: {_in_words(settings)}"
        remarks.append(f"settings of {agents(untraced)} are not recorded; assumed: {source}")
    settings = Counter(header.settings for header in headers.values()).most_common(1)[0][0] if headers else Settings()
    if not headers:
        raise FieldError("; ".join([*other_records.problems[:1], NO_INPUTS]))
    common_initial_data = Counter(header.initial_data for header in headers.values()).most_common(1)[0][0]
    data = common_initial_data if initial_data is None else base64.b64decode(initial_data)
    return MissionConfiguration(name, tuple(sorted(roster)), data, settings), headers


def _in_words(settings: Settings) -> str:
    default = asdict(Settings())
    changed = [f"{name} {value}" for name, value in asdict(settings).items() if value != default[name]]
    return ", ".join(changed) or "the thesis's"


def _initial_data(flight: Flight) -> str | None:
    """Return the data of the inception block in base64. Return None if the data are unknown."""
    if flight.initial_data is not None:
        return base64.b64encode(flight.initial_data).decode("ascii")
    return next((export.inception.block_data for export in flight.exports.values()), None)


def _assumed(
    other_records: OtherRecords, agent_id: int, settings: Settings, *, roster: Iterable[int], initial_data: str
) -> CheckedHeader:
    header = TraceHeader(agent_id=agent_id, roster=sorted(roster), settings={}, clock={}, initial_data=initial_data)
    return other_records.with_seal(replace(checked(header), settings=settings))

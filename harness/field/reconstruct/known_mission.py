"""What the agents of a flight were told before it: the mission, and each agent's settings and clock."""

import base64
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial

from harness.archive.traces import Header
from harness.checker.judgement import agents
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import FieldError
from harness.field.ingest import Flight
from harness.field.reconstruct.inferred_settings import likely
from harness.field.reconstruct.other_records import Elsewhere
from ucp.settings import Settings

NOTHING = (
    "no agent's record says what reached it: bring traces (*.trace.jsonl), or captures beside exports, "
    "so that there is something to fly again"
)


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
        whose = "as the others'" if common else f"those that explain the most: {_in_words(settings)}"
        remarks.append(f"settings of {agents(untraced)} are not on record, and assumed to be {whose}")
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

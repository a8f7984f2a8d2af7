"""Assign the flight logs of vehicles to the flights of their agents."""

from base64 import b64decode
from collections.abc import Iterable, Sequence

from harness.field.flight_logs import FlightLog
from harness.field.flight_logs._matching import match_logs
from harness.field.flight_logs._summary import in_words
from harness.field.ingest._ingest import FileRemark, Flight, UnusedPart
from ucp.events import MalformedEventsError, decode_events
from ucp.telemetry import Position, position_of


def assign_flight_logs(
    flights: Sequence[Flight], logs: Iterable[FlightLog], left_out: list[UnusedPart], remarks: list[FileRemark]
) -> None:
    """Assign each flight log to the first flight in which an agent flew on the vehicle of the log. Omit the logs of
    unknown vehicles.
    """
    fixes = [_logged_positions(flight) for flight in flights] if logs else []
    for log in logs:
        remarks += [FileRemark(log.path, problem) for problem in log.problems]
        unmatched = []
        for number in range(len(log.vehicles)):
            why = ""
            for flight, positions in zip(flights, fixes, strict=True):
                match = match_logs([log], positions)[number]
                if match.agent_id is not None:
                    flight.flight_logs.append(match)
                    remarks.append(FileRemark(log.path, in_words(match).removeprefix(f"{log.path}: ")))
                    break
                why = why or in_words(match).removeprefix(f"{log.path}: ")
            else:
                unmatched.append(why)
        left_out += [UnusedPart(log.path, why or "a flight log without a flight of agents") for why in unmatched]
        if not log.vehicles:
            left_out.append(UnusedPart(log.path, f"a {log.kind} log without a vehicle"))


def _logged_positions(flight: Flight) -> dict[int, list[tuple[int, Position]]]:
    """Return the positions that each agent logged, in order of time, from all blocks that any record contains."""
    found: dict[int, dict[int, Position]] = {agent_id: {} for agent_id in {*flight.agents, *flight.roster}}
    data = {(block.agent_id, block.event_bytes) for export in flight.exports.values() for block in export.blocks()}
    data |= {(agent_id, b64decode(export.current_block.event_data)) for agent_id, export in flight.exports.items()}
    for agent_id, event_data in data:
        try:
            events = decode_events(event_data)
        except MalformedEventsError:
            continue
        of_agent = found.setdefault(agent_id, {})
        for event in events:
            if (position := position_of(event.event_id, event.data)) is not None:
                of_agent[event.timestamp_us] = position
    for agent_id, logged in flight.logged.items():
        for event in logged:
            if (position := position_of(event.event_id, event.data)) is not None:
                found[agent_id][event.timestamp_us] = position
    return {agent_id: sorted(positions.items()) for agent_id, positions in found.items()}

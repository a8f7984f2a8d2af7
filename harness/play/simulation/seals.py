"""What agents sealed, as it is on record: whoever has not a vehicle's keys cannot seal it again."""

import base64
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from harness.scenario.agent_options import ScriptedEvent
from ucp.events import MalformedEventsError, decode_events
from ucp.sealed import SEAL_BYTES


@dataclass(frozen=True)
class SealsOnRecord:
    """By the event that filled the block, encoded; a block of which nothing is on record stays as it is."""

    sealed: Mapping[bytes, bytes]

    def __call__(self, event_data: bytes, timestamp_us: int) -> bytes:
        try:
            last = decode_events(event_data)[-1].encode()
        except (MalformedEventsError, IndexError):
            return event_data
        sealed = self.sealed.get(last, b"")
        return sealed if len(sealed) == len(event_data) + SEAL_BYTES else event_data


def seals_of(script: Iterable[ScriptedEvent], agent_id: int) -> SealsOnRecord | None:
    """What the script says that this agent sealed; None if nothing."""
    sealed = {
        event.logged.encode(): base64.b64decode(event.sealed)
        for event in script
        if event.agent == agent_id and event.sealed is not None
    }
    return SealsOnRecord(sealed) if sealed else None

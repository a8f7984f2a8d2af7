"""Reuse encrypted event data from the records of a mission, because a replay does not have the keys of the vehicles."""

import base64
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from harness.scenario.agent_options import ScriptedEvent
from ucp.events import MalformedEventsError, decode_events
from ucp.sealed import SEAL_BYTES


@dataclass(frozen=True)
class RecordedSeals:
    """A substitute for encryption that returns the recorded encrypted data. Event data without a record are not
    encrypted.
    """

    sealed: Mapping[bytes, bytes]
    """Last event of a block, encoded as bytes -> the encrypted event data of the block."""

    def __call__(self, event_data: bytes, timestamp_us: int) -> bytes:
        try:
            last = decode_events(event_data)[-1].encode()
        except (MalformedEventsError, IndexError):
            return event_data
        sealed = self.sealed.get(last, b"")
        return sealed if len(sealed) == len(event_data) + SEAL_BYTES else event_data


def recorded_seals(script: Iterable[ScriptedEvent], agent_id: int) -> RecordedSeals | None:
    """Return the encrypted event data of this agent from a script of events. Return None if the script has no encrypted
    data.
    """
    sealed = {
        event.logged.encode(): base64.b64decode(event.sealed)
        for event in script
        if event.agent == agent_id and event.sealed is not None
    }
    return RecordedSeals(sealed) if sealed else None

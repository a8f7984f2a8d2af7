"""Event data as the exports of a mission have it: in plain, or sealed to the depot, whose key then opens it."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.archive.exports import Export, ExportedBlock
from harness.errors import ExportError
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.sealed import sealed_to

if TYPE_CHECKING:
    from ucp.secure.sealing import Depot


class SealedError(MalformedEventsError):
    """Event data that is sealed, and no key opens: the end of a sentence."""


@dataclass(frozen=True)
class EventData:
    """Reads the events of blocks; `sealed` says whether the mission seals them, `depot` is who opens them, if here."""

    sealed: bool = False
    depot: "Depot | None" = None

    @property
    def is_closed(self) -> bool:
        """Whether nothing of it can be read here."""
        return self.sealed and self.depot is None

    @classmethod
    def of(cls, exports: Iterable[Export], depot: "Depot | None" = None) -> "EventData":
        """Of exports of one mission. Raises ExportError for another depot's key, or one where nothing is sealed."""
        inception = next((export.inception.data for export in exports), b"")
        key = sealed_to(inception)
        if depot is not None and key != depot.public_key:
            why = (
                "no event data is sealed in this mission"
                if key is None
                else "the event data of this mission is sealed to another depot"
            )
            raise ExportError(
                f"the depot key opens no event data here: {why}; leave out --depot-key, or give another key"
            )
        return cls(key is not None, depot)

    def of_block(self, block: ExportedBlock) -> bytes:
        """The events, as a block has them (Section 3.1). Raises SealedError."""
        return self.opened(block.event_bytes, block.agent_id, block.timestamp_us)

    def opened(self, event_data: bytes, agent_id: int, timestamp_us: int) -> bytes:
        """The same of a block's own bytes."""
        if not self.sealed:
            return event_data
        if self.depot is None:
            raise SealedError("sealed to the depot")
        from ucp.secure.sealing import NotOpenedError

        try:
            return self.depot.open(event_data, agent_id, timestamp_us)
        except NotOpenedError as error:
            raise SealedError(str(error)) from None

    def events(self, block: ExportedBlock) -> list[LoggableEvent]:
        """Oldest first. Raises MalformedEventsError, for sealed ones SealedError."""
        return decode_events(self.of_block(block))

"""Decode the event data of blocks, and decrypt them if the key is known.

In a secured mission, agents may encrypt event data for the depot. Only the depot's key decrypts them.
"""

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
    """An error: the event data of a block are encrypted, and no known key decrypts them. The message completes a
    sentence about the block.
    """


@dataclass(frozen=True)
class EventData:
    """A decoder for the event data of one mission. `sealed` is true if the data are encrypted. `depot` contains the key
    of the depot, or is None if the key is unknown.
    """

    sealed: bool = False
    depot: "Depot | None" = None

    @property
    def is_closed(self) -> bool:
        """True if the data are encrypted and the key is unknown."""
        return self.sealed and self.depot is None

    @classmethod
    def of(cls, exports: Iterable[Export], depot: "Depot | None" = None) -> "EventData":
        """Return the decoder for the mission of these exports.

        Raises ExportError if `depot` is given, but the mission encrypts its data for another depot or does not encrypt
        them.
        """
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
        """Return the decrypted event data of a block (Section 3.1). Raises SealedError if the key is unknown
        or wrong.
        """
        return self.opened(block.event_bytes, block.agent_id, block.timestamp_us)

    def opened(self, event_data: bytes, agent_id: int, timestamp_us: int) -> bytes:
        """Decrypt these event data, and return them. `agent_id` and `timestamp_us` belong to the block that contains
        the data.

        Raises SealedError.
        """
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
        """Return the events in a block. The oldest is first. Raises SealedError, or MalformedEventsError for damaged
        data.
        """
        return decode_events(self.of_block(block))

"""Define a line of `channel.jsonl`, the log of a shared radio channel. Each line describes a message that a radio sent
or dropped.
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

CHANNEL_FILE = "channel.jsonl"

Reason = Annotated[str, Field(max_length=20)]


class ChannelLine(BaseModel):
    """One message on the shared channel: its receivers and losses. `sequence` is the sequence number of the message, or
    None for a datagram that is not a message of the vehicle's agent.
    """

    model_config = ConfigDict(strict=True, defer_build=True)

    sender: int
    sequence: int | None
    lost: dict[Reason, list[int]] = {}
    """Reason -> vehicles that lost the message."""
    dropped: Reason | None = None
    """The reason why the radio did not send the message. None if it was sent."""

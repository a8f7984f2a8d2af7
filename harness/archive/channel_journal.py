"""The journal of a shared channel: a line of `channel.jsonl` for each message that left a radio, or that it dropped."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

CHANNEL_FILE = "channel.jsonl"

Reason = Annotated[str, Field(max_length=20)]


class ChannelLine(BaseModel):
    """The fate of a message. `sequence` is its number, or None for a datagram that is no message of the vehicle's
    agent."""

    model_config = ConfigDict(strict=True)

    sender: int
    sequence: int | None
    lost: dict[Reason, list[int]] = {}
    """Reason -> vehicles that lost the message."""
    dropped: Reason | None = None
    """The reason for which the radio did not send the message, or None."""

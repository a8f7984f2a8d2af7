"""Describe scripted deliveries: rules that decide whether and when single messages arrive.

fates:
  - {message: Commit Block, block: "4.11", receiver: 2, drop: true}
  - {message: Next in Sequence Response, sender: 3, name: third}
  - {message: Next in Sequence Response, sender: 4, after: third}
  - {sender: 3, from_s: 300, until_s: 600, hold_until_s: 600}
  - {sender: 3, receiver: 4, arrivals: 0@12.3 1@12.75 4@31}
"""

import re
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from harness.scenario.strict_model import Arrivals, MissionSecond, StrictModel, VehicleId

MessageName = Literal[
    "Block Add Request",
    "Block Add Response",
    "Commit Block",
    "Chain Contain Query",
    "Chain Contain Response",
    "Chain Hash Successor Query",
    "Next in Sequence Response",
    "Request for Block",
    "Block Response",
]

_BLOCK_NAME = r"^[1-9]\d{0,4}\.[1-9]\d{0,6}$"
BlockName = Annotated[str, Field(pattern=_BLOCK_NAME)]
"""Name of a block: `<agent>.<ordinal>`. The ordinal numbers the completed blocks of this agent from 1. YAML needs
quotes: "4.10".
"""

OUTCOMES = ("drop", "delay_s", "hold_until_s", "after", "arrivals")
"""Keys of a fate that decide about the delivery of a message."""

FateName = Annotated[str, Field(min_length=1, max_length=100)]


def _quoted(value: Any) -> Any:
    if isinstance(value, float):
        raise ValueError(
            f'should be quoted, as in "{value}": without quotes, YAML reads the blocks 4.1 and 4.10 as the same number'
        )
    if isinstance(value, str) and not re.match(_BLOCK_NAME, value):
        raise ValueError('must be an agent and the number of its block, such as "4.11"')
    return value


class Fate(StrictModel):
    """A rule that decides about the delivery of the messages that match it.

    A message matches if it has the values of all keys `message`, `sender`, `receiver`, `block`, `from_s` and `until_s`
    that the fate contains. If several fates match, the first one decides. A fate needs exactly one of `drop`,
    `delay_s`, `hold_until_s`, `after` and `arrivals`, or only a `name`. A fate that has only a name leaves the delivery
    to the network conditions. A partition stops messages in any case.
    """

    message: MessageName | None = None
    """Type of the message. By default, any type matches."""
    sender: VehicleId | None = None
    """ID of the sender. By default, any sender matches."""
    receiver: VehicleId | None = None
    """ID of the receiver. By default, every receiver matches."""
    block: Annotated[BlockName | None, BeforeValidator(_quoted)] = None
    """Block that the message concerns: an agent and the number of its block, in quotes, as in "4.11"."""
    count: Annotated[int, Field(ge=1)] | list[Annotated[int, Field(ge=1)]] | None = None
    """Number of the matching message to which the rule applies, counted from 1, or a list of such numbers. By default,
    the rule applies to all matching messages.
    """
    from_s: MissionSecond | None = None
    """A message matches only if it was sent at or after this mission second."""
    until_s: MissionSecond | None = None
    """A message matches only if it was sent before this mission second, which must be later than `from_s`."""

    drop: Literal[True] | None = None
    """If true, the message is lost."""
    delay_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    """The message arrives after this number of mission seconds, regardless of the network conditions."""
    hold_until_s: MissionSecond | None = None
    """If the message would arrive before this mission second, it arrives at this mission second."""
    after: FateName | None = None
    """The message arrives directly after the message of the fate with this `name`."""
    arrivals: Arrivals | None = None
    """Arrivals of all datagrams from `sender` to `receiver`. In "0@12.3 1@12.75" datagram 0 arrives at mission second
    12.3 and datagram 1 at 12.75. The datagrams are numbered from 0, across reboots of the sender. A datagram that is
    listed twice arrives twice. All other datagrams are lost.
    """
    name: FateName | None = None
    """Name of the fate, to which `after` of another fate can refer. Two fates with the same name are an error."""

    @property
    def left_to_chance(self) -> bool:
        return all(getattr(self, key) is None for key in OUTCOMES)

    @property
    def counts(self) -> tuple[int, ...] | None:
        return (self.count,) if isinstance(self.count, int) else tuple(self.count) if self.count else None

    @model_validator(mode="after")
    def _one_outcome(self) -> "Fate":
        outcomes = [key for key in OUTCOMES if getattr(self, key) is not None]
        if len(outcomes) > 1 or not (outcomes or self.name):
            raise ValueError(
                "needs exactly one of `drop: true`, `delay_s`, `hold_until_s`, `after` or `arrivals`, or a `name`"
            )
        if self.arrivals is not None:
            others = [key for key in ("message", "block", "count", "from_s", "until_s", "name") if getattr(self, key)]
            if self.sender is None or self.receiver is None or others:
                raise ValueError("`arrivals` need `sender` and `receiver`, and exclude all other keys")
        if self.from_s is not None and self.until_s is not None and self.from_s >= self.until_s:
            raise ValueError(f"from_s {self.from_s:g} is not before until_s {self.until_s:g}")
        return self

    def describe(self) -> str:
        """Return the rule as text, such as "drop Commit Block of block 4.11 to 2"."""
        what = (
            "drop"
            if self.drop
            else f"delay by {self.delay_s:g} s"
            if self.delay_s is not None
            else f"hold until {self.hold_until_s:g} s"
            if self.hold_until_s is not None
            else f"deliver after {self.after!r}"
            if self.after
            else "deliver at the seconds given"
            if self.arrivals
            else f"name {self.name!r}"
        )
        words = [what, self.message or "every message"]
        words += [f"of block {self.block}"] if self.block else []
        words += [f"from {self.sender}"] if self.sender else []
        words += [f"to {self.receiver}"] if self.receiver else []
        words += [f"number {', '.join(map(str, self.counts))}"] if self.counts else []
        words += [f"sent from {self.from_s:g} s"] if self.from_s is not None else []
        words += [f"until {self.until_s:g} s"] if self.until_s is not None else []
        return " ".join(words)

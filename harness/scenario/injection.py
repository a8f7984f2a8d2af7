"""Describe injected messages: messages in a run that no agent sent.

timeline:
  - {at_s: 100, replay: {message: Commit Block, sender: 2, count: 3}}
  - {at_s: 200, duplicate: {for_s: 60, copies: 2}}
  - {at_s: 300, delay: {for_s: 60, by_s: 30, message: Block Add Request}}
  - {at_s: 400, corrupt: {for_s: 60, bits: 3, sender: 4}}
  - {at_s: 500, forge: {message: Commit Block, sender: 2}}
  - {at_s: 600, forge: {message: Block Add Response, sender: 3, approve: false, for_s: 60}}
  - {at_s: 700, flood: {for_s: 10, per_s: 50, message: Chain Contain Query}}
  - {at_s: 800, lie: {message: Commit Block, sender: 3, receivers: [1, 2], block: made 790.5, chain: ["2.1", "1.1"]}}

A rogue node plays the injections. The rogue node is a sender outside the swarm. It receives every message that an agent
sends, and every agent receives its messages, regardless of network conditions and partitions. It cannot remove
messages. If it sends a delayed or corrupted copy, the original also arrives. If it forges an answer, the true answer
also arrives.

datagrams:
  - {source: 32, datagram: VUMBBQ..., reaches: {10: 812.3, 28: 812.31}}
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from harness.scenario.fates import MessageName
from harness.scenario.strict_model import Data, MissionSecond, Seconds, StrictModel, VehicleId, VehicleKey

InjectionName = Literal["replay", "duplicate", "delay", "corrupt", "forge", "flood", "lie"]
INJECTIONS: tuple[InjectionName, ...] = ("replay", "duplicate", "delay", "corrupt", "forge", "flood", "lie")
"""Keys of a timeline entry that inject messages."""

MAX_FLOOD = 100_000
"""Maximum number of datagrams of one flood."""


class _MatchingMessages(StrictModel):
    """An injection that applies to messages which the rogue node received. `message` and `sender` select these
    messages.
    """

    message: MessageName | None = None
    """Type of the messages. By default, any type matches."""
    sender: VehicleId | None = None
    """ID of the sender. By default, any sender matches."""

    def matches(self, message: str, sender: int) -> bool:
        return self.message in (None, message) and self.sender in (None, sender)

    @property
    def lasts_s(self) -> float:
        """The number of mission seconds from the start of the injection to its last datagram."""
        return 0.0

    def in_words(self) -> str:
        whose = f" from {self.sender}" if self.sender is not None else ""
        return f"{self.message or 'every message'}{whose}"


class Replay(_MatchingMessages):
    """The rogue node sends the last matching messages again, byte for byte."""

    count: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of messages."""

    def in_words(self) -> str:
        return f"the last {self.count} of {super().in_words()}"


class _LastingInjection(_MatchingMessages):
    for_s: Seconds
    """Duration in mission seconds."""

    @property
    def lasts_s(self) -> float:
        return self.for_s

    def in_words(self) -> str:
        return f"{super().in_words()} for {self.for_s:g} s"


class Duplicate(_LastingInjection):
    """The rogue node repeats each matching message immediately."""

    copies: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of copies per message."""

    def in_words(self) -> str:
        return f"{super().in_words()}, {self.copies} more of each"


class DelayedCopy(_LastingInjection):
    """The rogue node repeats each matching message after `by_s` mission seconds."""

    by_s: Seconds
    """Mission seconds between the message and its copy."""

    @property
    def lasts_s(self) -> float:
        return self.for_s + self.by_s

    def in_words(self) -> str:
        return f"{super().in_words()}, again {self.by_s:g} s later"


class CorruptedCopy(_LastingInjection):
    """The rogue node repeats each matching message immediately, with flipped bits and a valid UDP checksum."""

    bits: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of flipped bits per message."""

    def in_words(self) -> str:
        return f"{super().in_words()}, {self.bits} bit{'s' if self.bits > 1 else ''} flipped"


class Forgery(StrictModel):
    """The rogue node sends messages in the name of an agent.

    A forged Commit Block is sent once. It contains a new block in the name of `sender`, on top of the last chain that
    the rogue node knows. The other messages are answers. During `for_s`, when an agent other than `sender` sends a
    query, the rogue node answers the query before `sender` does. A forged answer to a Chain Hash Successor Query is
    always "Is Top Of Chain".
    """

    ANSWERS: ClassVar = ("Block Add Response", "Chain Contain Response", "Next in Sequence Response")

    message: Literal["Commit Block", "Block Add Response", "Chain Contain Response", "Next in Sequence Response"]
    """Type of the message."""
    sender: VehicleId
    """ID of the agent in whose name the rogue node sends."""
    for_s: Seconds | None = None
    """Duration in mission seconds. Required for answers, and an error for a Commit Block."""
    approve: bool | None = None
    """True if a forged Block Add Response approves, or a forged Chain Contain Response answers yes. The default is
    false. For other messages, the key is an error.
    """

    @property
    def lasts_s(self) -> float:
        return self.for_s or 0.0

    @model_validator(mode="after")
    def _check_values(self) -> "Forgery":
        if (self.for_s is None) != (self.message == "Commit Block"):
            raise ValueError(f"forged answers ({', '.join(self.ANSWERS)}) need `for_s`; no other message has it")
        if self.approve is not None and self.message not in self.ANSWERS[:2]:
            raise ValueError(f"`approve` belongs to {' and '.join(self.ANSWERS[:2])}; a {self.message} has no vote")
        return self

    def in_words(self) -> str:
        vote = "" if self.message not in self.ANSWERS[:2] else f" saying {'yes' if self.approve else 'no'}"
        span = "" if self.for_s is None else f" to every question for {self.for_s:g} s"
        return f"{self.message} from {self.sender}{vote}{span}"


class Flood(_LastingInjection):
    """The rogue node sends well-formed messages with random content in the names of random agents.

    More than 100,000 messages are an error.
    """

    per_s: Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
    """Number of messages per mission second."""

    @model_validator(mode="after")
    def _can_be_counted(self) -> "Flood":
        if self.for_s * self.per_s > MAX_FLOOD:
            raise ValueError(f"{self.for_s * self.per_s:g} messages are too many: a flood has at most {MAX_FLOOD}")
        return self

    def in_words(self) -> str:
        return f"{super().in_words()}, {self.per_s:g} a second"


BlockName = Annotated[str, Field(pattern=r"^(\d{1,5}\.\d{1,6}|made \d{1,9}(\.\d{1,6})?)$")]


class Lie(StrictModel):
    """The rogue node sends one message with the given content in the name of an agent.

    The type of the message determines which of the keys `block`, `chain`, `approve` and `timestamp_s` are required. A
    missing or additional key is an error.
    """

    REQUIRED_KEYS: ClassVar[dict[str, tuple[str, ...]]] = {
        "Block Add Request": ("block", "chain"),
        "Block Add Response": ("block", "approve"),
        "Commit Block": ("block", "chain"),
        "Chain Contain Query": ("chain",),
        "Chain Contain Response": ("chain", "approve"),
        "Chain Hash Successor Query": ("chain",),
        "Next in Sequence Response": ("chain", "timestamp_s"),
        "Request for Block": ("block",),
        "Block Response": ("block",),
    }
    OPTIONAL_KEYS: ClassVar[dict[str, tuple[str, ...]]] = {
        "Block Add Response": ("chain",),
        "Next in Sequence Response": ("block",),
    }

    message: MessageName
    """Type of the message."""
    sender: VehicleId
    """ID of the agent in whose name the rogue node sends."""
    receivers: Annotated[list[VehicleId], Field(min_length=1)] | None = None
    """IDs of the agents that receive the message. By default, all agents receive it."""
    block: BlockName | None = None
    """Block in the message. "2.1" is the first block that agent 2 proposed. "made 12.5" is a new block in the name of
    `sender` with a timestamp of 12.5 mission seconds. A Next in Sequence Response without a block means "Is Top Of
    Chain"."""
    chain: Annotated[list[BlockName], Field(max_length=1000)] | Literal["nobody's"] | None = None
    """Blocks of the chain in the message, oldest first, without the inception block. `nobody's` stands for a hash that
    no chain has. The block of a Commit Block is on top of this chain.
    """
    approve: bool | None = None
    """True if the message approves the block, or states that the chain of `sender` contains `chain`."""
    timestamp_s: MissionSecond | None = None
    """Timestamp in a Next in Sequence Response, in mission seconds."""

    @property
    def lasts_s(self) -> float:
        return 0.0

    @model_validator(mode="after")
    def _check_keys(self) -> "Lie":
        needs, may = self.REQUIRED_KEYS[self.message], self.OPTIONAL_KEYS.get(self.message, ())
        given = {key for key in ("block", "chain", "approve", "timestamp_s") if getattr(self, key) is not None}
        if not {*needs} <= given <= {*needs, *may}:
            allowed = f", and may have {' and '.join(f'`{key}`' for key in may)}" if may else ""
            raise ValueError(f"a {self.message} needs {' and '.join(f'`{key}`' for key in needs)}{allowed}")
        return self

    def in_words(self) -> str:
        receivers = "" if self.receivers is None else f" to {' and '.join(map(str, self.receivers))} alone"
        about = "" if self.block is None else f" about block {self.block}"
        chain = self.chain if isinstance(self.chain, str) else " ".join(self.chain or ()) or "inception"
        on = "" if self.chain is None else f", chain {chain}"
        vote = "" if self.approve is None else f", saying {'yes' if self.approve else 'no'}"
        return f"{self.message} from {self.sender}{receivers}{about}{on}{vote}"


Injection = Replay | Duplicate | DelayedCopy | CorruptedCopy | Forgery | Flood | Lie
MODELS: dict[str, type[Injection]] = {
    "replay": Replay,
    "duplicate": Duplicate,
    "delay": DelayedCopy,
    "corrupt": CorruptedCopy,
    "forge": Forgery,
    "flood": Flood,
    "lie": Lie,
}


MAX_CHARACTERS = 4 * (65536 // 3 + 1)
"""Maximum length in base64 of a UDP datagram."""


class ScriptedDatagram(StrictModel):
    """A datagram that no agent sent. Network conditions and partitions do not apply to it."""

    source: VehicleId
    """Vehicle whose address is the source of the datagram."""
    datagram: Annotated[Data, Field(max_length=MAX_CHARACTERS)]
    """Content, in base64."""
    reaches: Annotated[dict[VehicleKey, MissionSecond], Field(min_length=1)]
    """ID of each receiver -> mission second of the arrival."""

"""Injections and stray datagrams: what a scenario sends that none of its agents sent.

timeline:
  - {at_s: 100, replay: {message: Commit Block, sender: 2, count: 3}}
  - {at_s: 200, duplicate: {for_s: 60, copies: 2}}
  - {at_s: 300, delay: {for_s: 60, by_s: 30, message: Block Add Request}}
  - {at_s: 400, corrupt: {for_s: 60, bits: 3, sender: 4}}
  - {at_s: 500, forge: {message: Commit Block, sender: 2}}
  - {at_s: 600, forge: {message: Block Add Response, sender: 3, approve: false, for_s: 60}}
  - {at_s: 700, flood: {for_s: 10, per_s: 50, message: Chain Contain Query}}
  - {at_s: 800, lie: {message: Commit Block, sender: 3, receivers: [1, 2], block: made 790.5, chain: ["2.1", "1.1"]}}

`message` and `sender` that are left out mean any. The rogue hears everything that agents send, and everybody hears the
rogue, whatever keeps agents apart. It adds to what is on the air and can take nothing away: an original that it delays,
corrupts or forges an answer to arrives as well.

datagrams:
  - {source: 32, datagram: VUMBBQ..., reaches: {10: 812.3, 28: 812.31}}
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from harness.scenario.fates import MessageName
from harness.scenario.strict_model import Data, Instant, Model, Seconds, VehicleId, VehicleKey

InjectionName = Literal["replay", "duplicate", "delay", "corrupt", "forge", "flood", "lie"]
INJECTIONS: tuple[InjectionName, ...] = ("replay", "duplicate", "delay", "corrupt", "forge", "flood", "lie")
"""Keys of a timeline entry."""

MAX_FLOOD = 100_000
"""Datagrams of one flood."""


class _Matching(Model):
    """Of what is heard, the messages of this type and sender."""

    message: MessageName | None = None
    sender: VehicleId | None = None

    def matches(self, message: str, sender: int) -> bool:
        return self.message in (None, message) and self.sender in (None, sender)

    @property
    def lasts_s(self) -> float:
        """Mission seconds from its beginning until nothing more comes of it."""
        return 0.0

    def in_words(self) -> str:
        whose = f" from {self.sender}" if self.sender is not None else ""
        return f"{self.message or 'every message'}{whose}"


class Replay(_Matching):
    """What was heard before and matches: the last `count` of it once more, byte for byte."""

    count: Annotated[int, Field(ge=1, le=1000)] = 1

    def in_words(self) -> str:
        return f"the last {self.count} of {super().in_words()}"


class _Lasting(_Matching):
    for_s: Seconds

    @property
    def lasts_s(self) -> float:
        return self.for_s

    def in_words(self) -> str:
        return f"{super().in_words()} for {self.for_s:g} s"


class Duplicate(_Lasting):
    """For `for_s` whatever matches is sent again at once, `copies` times."""

    copies: Annotated[int, Field(ge=1, le=100)] = 1

    def in_words(self) -> str:
        return f"{super().in_words()}, {self.copies} more of each"


class DelayedCopy(_Lasting):
    """For `for_s` whatever matches is sent again `by_s` later."""

    by_s: Seconds

    @property
    def lasts_s(self) -> float:
        return self.for_s + self.by_s

    def in_words(self) -> str:
        return f"{super().in_words()}, again {self.by_s:g} s later"


class Corrupt(_Lasting):
    """For `for_s` whatever matches is sent again at once with `bits` of it flipped, under a good UDP checksum."""

    bits: Annotated[int, Field(ge=1, le=1000)] = 1

    def in_words(self) -> str:
        return f"{super().in_words()}, {self.bits} bit{'s' if self.bits > 1 else ''} flipped"


class Forge(Model):
    """A message that `sender` never sent.

    Commit Block, at once: a block that claims to be the sender's, on top of the chain that the rogue has heard of last.
    The others, for `for_s`: an answer to each question, ahead of the sender's own; to a query for a successor always
    "Is Top Of Chain". `approve` is what the answer says.
    """

    ANSWERS: ClassVar = ("Block Add Response", "Chain Contain Response", "Next in Sequence Response")

    message: Literal["Commit Block", "Block Add Response", "Chain Contain Response", "Next in Sequence Response"]
    sender: VehicleId
    for_s: Seconds | None = None
    approve: bool | None = None

    @property
    def lasts_s(self) -> float:
        return self.for_s or 0.0

    @model_validator(mode="after")
    def _means_something(self) -> "Forge":
        if (self.for_s is None) != (self.message == "Commit Block"):
            raise ValueError(f"`for_s` belongs to a forged answer, and each needs it: {', '.join(self.ANSWERS)}")
        if self.approve is not None and self.message not in self.ANSWERS[:2]:
            raise ValueError(f"`approve` belongs to {' and '.join(self.ANSWERS[:2])}: a {self.message} says neither")
        return self

    def in_words(self) -> str:
        says = "" if self.message not in self.ANSWERS[:2] else f" saying {'yes' if self.approve else 'no'}"
        span = "" if self.for_s is None else f" to every question for {self.for_s:g} s"
        return f"{self.message} from {self.sender}{says}{span}"


class Flood(_Lasting):
    """For `for_s`, `per_s` well-formed messages a mission second, of random content and in random names."""

    per_s: Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]

    @model_validator(mode="after")
    def _can_be_counted(self) -> "Flood":
        if self.for_s * self.per_s > MAX_FLOOD:
            raise ValueError(f"{self.for_s * self.per_s:g} messages are too many: a flood has {MAX_FLOOD} at most")
        return self

    def in_words(self) -> str:
        return f"{super().in_words()}, {self.per_s:g} a second"


BlockName = Annotated[str, Field(pattern=r"^(\d{1,5}\.\d{1,6}|made \d{1,9}(\.\d{1,6})?)$")]


class Lie(Model):
    """One message in `sender`'s name, of just this content, which `receivers` hear; everybody if they are left out.

    `block` is the block that it is about: "2.1" is the first that agent 2 has proposed, "made 12.5" one that the rogue
    makes in the sender's name, with that timestamp in mission seconds. `chain` are the blocks of the chain that it is
    about, the oldest first, or `nobody's`; that of a Commit Block is what its block goes on top of. A Next in Sequence
    Response without `block` says "Is Top Of Chain".
    """

    NEEDS: ClassVar[dict[str, tuple[str, ...]]] = {
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
    MAY_HAVE: ClassVar[dict[str, tuple[str, ...]]] = {
        "Block Add Response": ("chain",),
        "Next in Sequence Response": ("block",),
    }

    message: MessageName
    sender: VehicleId
    receivers: Annotated[list[VehicleId], Field(min_length=1)] | None = None
    block: BlockName | None = None
    chain: Annotated[list[BlockName], Field(max_length=1000)] | Literal["nobody's"] | None = None
    approve: bool | None = None
    timestamp_s: Instant | None = None

    @property
    def lasts_s(self) -> float:
        return 0.0

    @model_validator(mode="after")
    def _says_all_of_it(self) -> "Lie":
        needs, may = self.NEEDS[self.message], self.MAY_HAVE.get(self.message, ())
        given = {key for key in ("block", "chain", "approve", "timestamp_s") if getattr(self, key) is not None}
        if not {*needs} <= given <= {*needs, *may}:
            allowed = f", and may have {' and '.join(f'`{key}`' for key in may)}" if may else ""
            raise ValueError(f"a {self.message} says {' and '.join(f'`{key}`' for key in needs)}{allowed}")
        return self

    def in_words(self) -> str:
        whom = "" if self.receivers is None else f" to {' and '.join(map(str, self.receivers))} alone"
        about = "" if self.block is None else f" about block {self.block}"
        chain = self.chain if isinstance(self.chain, str) else " ".join(self.chain or ()) or "inception"
        on = "" if self.chain is None else f", chain {chain}"
        says = "" if self.approve is None else f", saying {'yes' if self.approve else 'no'}"
        return f"{self.message} from {self.sender}{whom}{about}{on}{says}"


Injection = Replay | Duplicate | DelayedCopy | Corrupt | Forge | Flood | Lie
MODELS: dict[str, type[Injection]] = {
    "replay": Replay,
    "duplicate": Duplicate,
    "delay": DelayedCopy,
    "corrupt": Corrupt,
    "forge": Forge,
    "flood": Flood,
    "lie": Lie,
}


MAX_CHARACTERS = 4 * (65536 // 3 + 1)
"""What the largest datagram that UDP has is in base64."""


class ScriptedDatagram(Model):
    """`datagram`, in base64, under the address of vehicle `source`, `reaches` these agents at these mission seconds.

    Nothing else becomes of it: no loss, no partition.
    """

    source: VehicleId
    datagram: Annotated[Data, Field(max_length=MAX_CHARACTERS)]
    reaches: Annotated[dict[VehicleKey, Instant], Field(min_length=1)]

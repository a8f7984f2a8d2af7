"""Represent the network conditions of packets from one vehicle to another: loss, delay, duplicates, reordering, and
more.

Names and meanings are those of tc-netem(8). The random draws of each packet are independent. The JSON form omits
default values. For example, a link that has only loss is {"loss": 0.1}.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, Self, get_args

from netem.errors import ConditionsError

Distribution = Literal["uniform", "normal", "pareto", "paretonormal"]

MAX_DELAY_S = 60.0
"""Maximum delay in seconds: six times the longest timer of UCP in the thesis. netem itself allows 274 s (32 bits of 64
ns ticks)."""

MAX_LIMIT = 100_000
"""Greatest value of `limit`, the maximum number of waiting packets. If a link has no `limit`, the kernel lets at most
MAX_LIMIT + 1 packets wait, so that a flood of packets cannot fill its memory.
"""


@dataclass(frozen=True)
class GilbertElliott:
    """A model of loss in bursts, as in netem's `loss gemodel p r 1-h 1-k`. Each value is a probability, 0 to 1.

    A link is in a good or a bad state and starts in the good one. A packet is lost with the probability of the current
    state. Then the state may change: with probability `p` from good to bad, with probability `r` from bad to good.
    """

    p: float
    r: float
    loss_bad: float = 1.0
    loss_good: float = 0.0

    def __post_init__(self) -> None:
        for key, value in asdict(self).items():
            object.__setattr__(self, key, probability(f"loss.{key}", value))

    @property
    def mean(self) -> float:
        """The mean share of lost packets over a long time, from 0 to 1."""
        change = self.p + self.r
        return self.loss_good + (self.loss_bad - self.loss_good) * (self.p / change) if change else self.loss_good

    @property
    def lossless(self) -> bool:
        """True if no packet can be lost, in any state of the link."""
        return self.loss_good == 0.0 and (self.p == 0.0 or self.loss_bad == 0.0)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> GilbertElliott:
        """Create the model from a JSON object in the format of `to_json`. Raises ConditionsError."""
        return cls(**keywords(cls, value, "loss", required=("p", "r")))


@dataclass(frozen=True)
class Delay:
    """The delay of packets in seconds. Its mean is 0 to 60.

    In the uniform distribution, `jitter_s` is the greatest deviation from the mean. In the other distributions, which
    are drawn from netem's tables, `jitter_s` is the standard deviation. `jitter_s` is at most `mean_s`, so a uniform
    delay is never negative. Negative delays in the tail of the other distributions become 0, as in netem.
    """

    mean_s: float
    jitter_s: float = 0.0
    distribution: Distribution = "uniform"

    def __post_init__(self) -> None:
        mean_s = _number("delay.mean_s", self.mean_s, f"seconds 0..{MAX_DELAY_S:g}")
        if not 0.0 <= mean_s <= MAX_DELAY_S:
            raise ConditionsError(f"delay.mean_s: {mean_s!r} is out of range; allowed is seconds 0..{MAX_DELAY_S:g}")
        jitter_s = _number("delay.jitter_s", self.jitter_s, "seconds 0..mean_s")
        if not 0.0 <= jitter_s <= mean_s:
            raise ConditionsError(f"delay.jitter_s: {jitter_s!r} is out of range; allowed is 0..mean_s, {mean_s:g}")
        if self.distribution not in get_args(Distribution):
            allowed = ", ".join(get_args(Distribution))
            raise ConditionsError(f"delay.distribution: {self.distribution!r} is not known; allowed is {allowed}")
        object.__setattr__(self, "mean_s", mean_s)
        object.__setattr__(self, "jitter_s", jitter_s)

    def at_speed(self, speedup: float) -> Delay:
        """Convert the delay from mission time to wall time. `speedup` is the number of mission seconds per second of
        wall time.
        """
        return replace(self, mean_s=self.mean_s / speedup, jitter_s=self.jitter_s / speedup)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Delay:
        """Create the delay from a JSON object in the format of `to_json`. Raises ConditionsError."""
        return cls(**keywords(cls, value, "delay", required=("mean_s",)))


@dataclass(frozen=True)
class LinkConditions:
    """The network conditions of packets to one receiver, from all senders or from one.

    `loss` is the probability, 0 to 1, that a packet is lost, or a model of bursts. Loss is drawn separately for each
    packet. `duplicate` is the probability that a packet arrives twice. Loss and duplication are drawn together: if a
    packet is both lost and duplicated, one copy remains. Otherwise loss and the other conditions are drawn separately
    for the second copy, which is not duplicated again. `reorder` is the probability that a packet is sent without
    delay, and so overtakes earlier packets. Reordering needs a delay above 0.

    `corrupt` is the probability that one bit of a packet flips. The receiver's UDP checksum finds the error, so the
    message is lost. (netem flips bits of the whole Ethernet frame. No checksum of a veth pair covers the 12 bytes of
    addresses, and a broadcast mostly arrives in spite of such an error.)

    `rate` is in bits per second of Ethernet frames, which are 42 bytes longer than the data of a UDP datagram. Each
    link from one sender to one receiver has the full rate. A packet waits for its delay and for the packet before it.
    The time of its transmission depends on its size and the rate. Packets therefore keep their order. `limit` is the
    number of packets that may wait on a link for delay or rate, at least 1. A packet that arrives at a full link is
    lost. Packets that overtake do not wait. Corrupted packets wait like all other packets.
    """

    loss: float | GilbertElliott = 0.0
    delay: Delay | None = None
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    rate: float | None = None
    limit: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.loss, GilbertElliott):
            object.__setattr__(self, "loss", probability("loss", self.loss))
        for key in ("duplicate", "reorder", "corrupt"):
            object.__setattr__(self, key, probability(key, getattr(self, key)))
        if not isinstance(self.delay, Delay | None):
            raise ConditionsError(f"delay: {self.delay!r} is not a delay; allowed is a Delay or None")
        if self.delay is not None and self.delay.mean_s == 0.0:
            object.__setattr__(self, "delay", None)
        if self.reorder and self.delay is None:
            raise ConditionsError(f"reorder: {self.reorder!r} needs a delay to overtake; allowed is 0 without one")
        if self.rate is not None:
            allowed = "bits per second, 8 or more, or None"
            rate = _number("rate", self.rate, allowed)
            if not 8.0 <= rate < math.inf:
                raise ConditionsError(f"rate: {self.rate!r} is out of range; allowed is {allowed}")
            object.__setattr__(self, "rate", rate)
        if self.limit is not None:
            allowed = f"a whole number of packets, 1..{MAX_LIMIT}, or None"
            if isinstance(self.limit, bool) or not isinstance(self.limit, int) or not 1 <= self.limit <= MAX_LIMIT:
                raise ConditionsError(f"limit: {self.limit!r} is out of range; allowed is {allowed}")
            if self.delay is None and self.rate is None:
                raise ConditionsError(f"limit: {self.limit!r} needs a delay or a rate to wait for; allowed is None")

    @property
    def lossless(self) -> bool:
        """True if no packet can be lost by loss, corruption or a full queue."""
        lossless = self.loss.lossless if isinstance(self.loss, GilbertElliott) else self.loss == 0.0
        return lossless and self.corrupt == 0.0 and self.limit is None

    @property
    def remembers(self) -> bool:
        """True if the link has a memory: earlier packets from the same sender to the same receiver affect whether a
        packet arrives, or when it arrives.
        """
        return isinstance(self.loss, GilbertElliott) or self.rate is not None or self.limit is not None

    @property
    def independent_loss(self) -> float:
        """The loss rate, if the loss of each packet is independent. Raises ConditionsError for loss in bursts."""
        if isinstance(self.loss, GilbertElliott):
            raise ConditionsError(f"loss: {self.loss} is in bursts; allowed here is a probability 0..1")
        return self.loss

    def needs(self) -> tuple[str, ...]:
        """Return the names of the network conditions in use, other than independent loss, such as "delay"."""
        asked = {
            "loss in bursts": isinstance(self.loss, GilbertElliott),
            "delay": self.delay is not None,
            "duplicate": self.duplicate > 0.0,
            "reorder": self.reorder > 0.0,
            "corrupt": self.corrupt > 0.0,
            "rate": self.rate is not None,
            "limit": self.limit is not None,
        }
        return tuple(key for key, needed in asked.items() if needed)

    def at_speed(self, speedup: float) -> Self:
        """Convert the network conditions from mission time to wall time. `speedup` is the number of mission seconds per
        second of wall time. Delays become shorter, and the rate becomes higher.
        """
        return replace(
            self,
            delay=self.delay and self.delay.at_speed(speedup),
            rate=self.rate and self.rate * speedup,
        )

    def to_json(self) -> dict[str, Any]:
        value: dict[str, Any] = {
            "loss": self.loss.to_json() if isinstance(self.loss, GilbertElliott) else self.loss,
            "delay": self.delay and self.delay.to_json(),
            "duplicate": self.duplicate,
            "reorder": self.reorder,
            "corrupt": self.corrupt,
            "rate": self.rate,
            "limit": self.limit,
        }
        return {key: asked for key, asked in value.items() if key == "loss" or asked}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> LinkConditions:
        """Create the network conditions from a JSON object in the format of `to_json`. Raises ConditionsError."""
        known = keywords(cls, value)
        for key, kind in (("loss", GilbertElliott), ("delay", Delay)):
            if isinstance(known.get(key), Mapping):
                known[key] = kind.from_json(known[key])
        return cls(**known)


def probability(key: str, value: object) -> float:
    """Return the value as a float. Raises ConditionsError if it is not a probability."""
    number = _number(key, value, "a probability 0..1")
    if not 0.0 <= number <= 1.0:
        hint = f" (for {value:g} % write {number / 100:g})" if 1.0 < number <= 100.0 else ""
        raise ConditionsError(f"{key}: {value!r} is not a probability; allowed is 0..1{hint}")
    return number


def keywords(cls: type[Any], value: Mapping[str, Any], at: str = "", required: tuple[str, ...] = ()) -> dict[str, Any]:
    """Check that the keys of a JSON object fit the fields of a dataclass. Return the object's keys and values. Raises
    ConditionsError for an unknown or missing key.
    """
    prefix = f"{at}." if at else ""
    allowed = [field.name for field in fields(cls)]
    for key in value:
        if key not in allowed:
            raise ConditionsError(f"{prefix}{key}: not a key of the conditions; allowed is {', '.join(allowed)}")
    for key in required:
        if key not in value:
            raise ConditionsError(f"{prefix}{key}: is missing; needed are {', '.join(required)}")
    return dict(value)


def _number(key: str, value: object, allowed: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConditionsError(f"{key}: {value!r} is not a number; allowed is {allowed}")
    try:
        number = float(value)
    except OverflowError:
        raise ConditionsError(f"{key}: the number is too large; allowed is {allowed}") from None
    if math.isnan(number):
        raise ConditionsError(f"{key}: {value!r} is not a number; allowed is {allowed}")
    return number

"""Measure how a network treats packets, and compare the results with the requested network conditions.

A *study* consists of network conditions, broadcasts under these conditions, and comparisons of measured values with
requested values. Each value describes the packets from one sender to one receiver. Each receiver has its own
conditions, so one stream of packets is enough for many comparisons. `measure` passes studies to an observer
(`netem.observers`), which sends real packets or simulates packets in virtual time. A measurement is right if its 99.9 %
interval (`netem.estimates`) contains the requested value.

Even with a right kernel, one of a thousand intervals does not contain the requested value. With thirty comparisons,
this happens in one of about thirty measurements. A wrong comparison is therefore repeated with a new stream. The second
result counts, and the first result is shown beside it. With thirty comparisons, a right kernel then fails about one of
30,000 measurements. A wrong kernel fails twice in a row.

The requested value is the value that the engine can reach. For a delay, it is the mean and deviation of netem's table
(`netem._distributions`). For corruption, it is the share of corrupted packets that checksums can detect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from statistics import fmean, median, pstdev, quantiles
from typing import Any, get_args

from netem import estimates
from netem._distributions import SCALE, table
from netem.conditions import NetworkConditions
from netem.engine import RESOLUTION
from netem.estimates import Estimate, MachineLateness, ReceivedStream
from netem.link import Delay, Distribution, GilbertElliott, LinkConditions

PACKETS = 10_000
DATA_BYTES = 12
"""Number of data bytes in each datagram of a measurement."""
REFERENCE = 3
"""The reference vehicle, which receives all packets in each study over perfect links."""

_FRAME_BITS = (DATA_BYTES + 42) * 8
_UNPROTECTED_BITS = 95
"""Number of bits of a frame that no checksum protects. These are the bits of the Ethernet addresses, except for the
group bit. A receiver ignores a broadcast whose group bit is corrupted.
"""
_TABLE_SIZE = 4094  # size of the kernel's tables
_SENDER, _OTHER_SENDER = 1, 2
_FIRST_FREE = 4


@dataclass(frozen=True)
class MeasuredQuantity:
    """A comparison to make. `estimate` computes a value from the packets between two vehicles. The comparison is right
    if this value equals the requested value `asked`.
    """

    sender: int
    receiver: int
    condition: str
    quantity: str
    asked: float
    estimate: Callable[[ReceivedStream], Estimate]
    unit: str = ""


@dataclass(frozen=True)
class NetworkStudy:
    """A measurement: network conditions, and the comparisons to make. All senders broadcast packets."""

    conditions: NetworkConditions
    questions: tuple[MeasuredQuantity, ...]

    @property
    def senders(self) -> tuple[int, ...]:
        return tuple(sorted({question.sender for question in self.questions}))

    @property
    def receivers(self) -> tuple[int, ...]:
        return tuple(sorted({question.receiver for question in self.questions}))

    @property
    def vehicles(self) -> tuple[int, ...]:
        """All vehicles of the measurement, including a reference vehicle with perfect links."""
        conditions = self.conditions
        named = {*conditions.receivers, *chain(*conditions.links), *chain(*conditions.partition)}
        return tuple(sorted({*self.senders, *self.receivers, *named, REFERENCE}))


Observer = Callable[[NetworkStudy, int], Mapping[tuple[int, int], ReceivedStream]]
"""A function that lets each sender of a study broadcast a number of packets. It returns the received packets by
(sender, receiver).
"""


@dataclass(frozen=True)
class AnswerRow:
    """A comparison and its result. If the first result was wrong, the measurement was repeated. `before` is then the
    first result.
    """

    engine: str
    question: MeasuredQuantity
    answer: Estimate
    before: Estimate | None = None

    @property
    def ok(self) -> bool:
        """True if the confidence interval contains the requested value. A difference below the resolution of the
        engines is tolerated.
        """
        asked = self.question.asked
        margin = RESOLUTION * max(1.0, asked)
        return self.answer.low - margin <= asked <= self.answer.high + margin

    def to_json(self) -> dict[str, Any]:
        asked = {key: getattr(self.question, key) for key in ("condition", "quantity", "unit", "asked")}
        before = self.before and asdict(self.before)
        return {"engine": self.engine, **asked, **asdict(self.answer), "ok": self.ok, "before": before}


@dataclass(frozen=True)
class EngineMeasurement:
    """All measurement results for one engine, and the delays in seconds that the machine itself adds."""

    engine: str
    rows: tuple[AnswerRow, ...]
    lateness: MachineLateness

    @property
    def ok(self) -> bool:
        return all(row.ok for row in self.rows)

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object.

        `lateness` has the median and the 99th percentile of the machine's delays in seconds, for packets in transit and
        for timers.
        """
        late = {"way": self.lateness.way_s, "timers": self.lateness.timers_s}
        lateness = {key: {"median_s": median(each), "p99_s": quantiles(each, n=100)[-1]} for key, each in late.items()}
        return {"engine": self.engine, "lateness": lateness, "rows": [row.to_json() for row in self.rows]}


def measure(
    engine: str, studies: Sequence[NetworkStudy], observe: Observer, packets: int = PACKETS
) -> EngineMeasurement:
    """Run the measurements, and repeat those with wrong results. Raises the errors of `observe`."""
    rows: list[AnswerRow] = []
    late: list[MachineLateness] = []
    for study in studies:
        streams = observe(study, packets)
        late.append(next(iter(streams.values())).lateness)
        answers = [AnswerRow(engine, question, _answer(question, streams)) for question in study.questions]
        if outside := tuple(row.question for row in answers if not row.ok):
            second_streams = observe(replace(study, questions=outside), packets)
            answers = [
                row if row.ok else replace(row, answer=_answer(row.question, second_streams), before=row.answer)
                for row in answers
            ]
        rows += answers
    ways, timers = (
        [*chain.from_iterable(values)] for values in zip(*((o.way_s, o.timers_s) for o in late), strict=True)
    )
    return EngineMeasurement(engine, tuple(rows), MachineLateness(ways, timers))


def _answer(question: MeasuredQuantity, streams: Mapping[tuple[int, int], ReceivedStream]) -> Estimate:
    return question.estimate(streams[question.sender, question.receiver])


# Studies


def studies(engine: str) -> tuple[NetworkStudy, ...]:
    """Return the measurements for an engine: loss and partitions for "nftables", all network conditions for the other
    engines.

    Duplicates have their own measurement, because some kernels do not allow them together with other conditions (see
    `netem.tc`).
    """
    if engine == "nftables":
        return (_receivers(_losses()), _pairs())
    noticed = 1.0 if engine == "medium" else 1 - _UNPROTECTED_BITS / _FRAME_BITS
    return (_receivers([*_losses(), *_other_conditions(noticed)]), _receivers(_duplicates()), _pairs())


@dataclass(frozen=True)
class _LinkCase:
    """The network conditions of a link, and the comparisons to make as (quantity, requested value, estimate, unit)."""

    condition: str
    link: LinkConditions
    figures: tuple[tuple[str, float, Callable[[ReceivedStream], Estimate], str], ...]


def _losses() -> list[_LinkCase]:
    shares = (0.01, 0.05, 0.15, 0.5)
    return [
        _LinkCase(f"loss {share:g}", LinkConditions(share), (("lost", share, estimates.lost, ""),)) for share in shares
    ]


def _other_conditions(noticed: float) -> list[_LinkCase]:
    """Return the cases for network conditions other than loss and duplicates. `noticed` is the share of corrupted
    packets that receivers detect.
    """
    bursts = GilbertElliott(p=0.05, r=0.25)
    fixed, jitter_s = Delay(0.1), 0.02
    rate, limit = 500_000.0, 50
    shapes = [Delay(fixed.mean_s, jitter_s, shape) for shape in get_args(Distribution)]
    return [
        _LinkCase(
            f"loss in bursts, p {bursts.p:g}, r {bursts.r:g}",
            LinkConditions(bursts),
            (
                ("lost", bursts.mean, estimates.lost_in_bursts, ""),
                ("mean burst", 1 / bursts.r, estimates.burst_length, "packets"),
            ),
        ),
        _LinkCase("delay 100 ms", LinkConditions(delay=fixed), (("mean", fixed.mean_s, estimates.delay_mean, "s"),)),
        *(_jittered(delay) for delay in shapes),
        _LinkCase(
            "reorder 0.25, delay 100 ms",
            LinkConditions(delay=fixed, reorder=0.25),
            (("came at once", 0.25, partial(estimates.undelayed, delay_s=fixed.mean_s), ""),),
        ),
        _LinkCase("corrupt 0.2", LinkConditions(corrupt=0.2), (("lost", 0.2 * noticed, estimates.lost, ""),)),
        _LinkCase(
            f"rate {rate / 1000:g} kbit/s",
            LinkConditions(rate=rate),
            (("rate", rate, partial(estimates.rate, packet_bits=_FRAME_BITS), "bit/s"),),
        ),
        _LinkCase(
            f"limit {limit}, delay 100 ms",
            LinkConditions(delay=fixed, limit=limit),
            (("waited", limit, partial(estimates.waiting_when_lost, delay_s=fixed.mean_s), "packets"),),
        ),
    ]


def _jittered(delay: Delay) -> _LinkCase:
    deviations = [entry / SCALE for entry in table(delay.distribution, _TABLE_SIZE)]
    mean_s = delay.mean_s + delay.jitter_s * fmean(deviations)
    deviation_s = delay.jitter_s * pstdev(deviations)
    return _LinkCase(
        f"delay {delay.mean_s * 1000:g} ± {delay.jitter_s * 1000:g} ms {delay.distribution}",
        LinkConditions(delay=delay),
        (("mean", mean_s, estimates.delay_mean, "s"), ("deviation", deviation_s, estimates.delay_deviation, "s")),
    )


def _duplicates() -> list[_LinkCase]:
    return [_LinkCase("duplicate 0.3", LinkConditions(duplicate=0.3), (("came twice", 0.3, estimates.duplicated, ""),))]


def _receivers(cases: Sequence[_LinkCase]) -> NetworkStudy:
    """Return a measurement with one sender and several receivers. Each receiver has the network conditions of one
    case.
    """
    numbered = dict(enumerate(cases, _FIRST_FREE))
    questions = [
        MeasuredQuantity(_SENDER, receiver, case.condition, *figure)
        for receiver, case in numbered.items()
        for figure in case.figures
    ]
    conditions = NetworkConditions(receivers={receiver: case.link for receiver, case in numbered.items()})
    return NetworkStudy(conditions, tuple(questions))


def _pairs() -> NetworkStudy:
    """Return a measurement with two senders that send at the same time. The link between the two senders has a
    different loss in each direction, and a partition separates one vehicle from all others.
    """
    there, back, rest = 0.4, 0.1, 0.2
    conditions = NetworkConditions(
        LinkConditions(rest),
        {REFERENCE: LinkConditions()},
        {
            (_SENDER, _OTHER_SENDER): LinkConditions(there),
            (_OTHER_SENDER, _SENDER): LinkConditions(back),
        },
    )
    bystander, cut = _FIRST_FREE, _FIRST_FREE + 1
    asked = f"loss {there:g} there, {back:g} back, else {rest:g}"
    return NetworkStudy(
        conditions.with_partition([[cut]]),
        (
            MeasuredQuantity(_SENDER, _OTHER_SENDER, asked, "lost there", there, estimates.lost),
            MeasuredQuantity(_OTHER_SENDER, _SENDER, asked, "lost back", back, estimates.lost),
            MeasuredQuantity(_SENDER, bystander, asked, "lost elsewhere", rest, estimates.lost),
            MeasuredQuantity(_SENDER, cut, "partition", "passed", 0.0, estimates.passed),
        ),
    )

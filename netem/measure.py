"""What a network does to packets, beside what was asked of it: the same questions to every engine.

A *study* is a network, broadcasts in it, and questions: of the packets from this sender to this receiver, what is that
figure? Every receiver has conditions of its own, so that one stream answers many questions. `measure` plays studies
before an observer (`netem.observers`: real packets, or those of virtual time) and judges each answer: the 99.9 %
interval of what was measured (`netem.estimates`) holds what was asked, or not.

Of a thousand right answers one lies outside such an interval, and of thirty rows one in thirty runs. So what lies
outside is measured once more, with a fresh stream: the second answer counts, the first stays beside it. A right kernel
fails a run of thirty rows once in 30,000; what is really wrong is wrong twice.

Asked is what the engine promises, to the last digit: of a delay the mean and the deviation of the table that netem is
given (`netem._distributions`), of corruption what a checksum can find.
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
from netem.estimates import Estimate, Heard, Lateness
from netem.link import Delay, Distribution, GilbertElliott, LinkConditions

PACKETS = 10_000
DATA_BYTES = 12
"""Of every datagram."""
REFERENCE = 3
"""The vehicle that hears everything, whatever is asked."""

_FRAME_BITS = (DATA_BYTES + 42) * 8
_UNPROTECTED_BITS = 95
"""Of a frame no checksum covers the Ethernet addresses, 96 bits; a broadcast that loses its group bit is lost."""
_TABLE_SIZE = 4094  # of the tables that the kernel is given
_SENDER, _OTHER_SENDER = 1, 2
_FIRST_FREE = 4


@dataclass(frozen=True)
class Question:
    """What `estimate` finds of the packets from one vehicle to another is asked to be so much."""

    sender: int
    receiver: int
    condition: str
    quantity: str
    asked: float
    estimate: Callable[[Heard], Estimate]
    unit: str = ""


@dataclass(frozen=True)
class Study:
    """Conditions, under which all who are a `sender` in a question broadcast, and the questions."""

    conditions: NetworkConditions
    questions: tuple[Question, ...]

    @property
    def senders(self) -> tuple[int, ...]:
        return tuple(sorted({question.sender for question in self.questions}))

    @property
    def receivers(self) -> tuple[int, ...]:
        return tuple(sorted({question.receiver for question in self.questions}))

    @property
    def vehicles(self) -> tuple[int, ...]:
        """All that are in it, with the reference, which no conditions and no partition may touch."""
        conditions = self.conditions
        named = {*conditions.receivers, *chain(*conditions.links), *chain(*conditions.partition)}
        return tuple(sorted({*self.senders, *self.receivers, *named, REFERENCE}))


Observer = Callable[[Study, int], Mapping[tuple[int, int], Heard]]
"""Has every sender of a study broadcast so many packets; what was heard, by sender and receiver of each question."""


@dataclass(frozen=True)
class Row:
    """A question of an engine and its answer; `before` is the first answer if it lay outside."""

    engine: str
    question: Question
    answer: Estimate
    before: Estimate | None = None

    @property
    def ok(self) -> bool:
        """What was asked lies in the interval of what was measured, to the digits that engines hold."""
        asked = self.question.asked
        margin = RESOLUTION * max(1.0, asked)
        return self.answer.low - margin <= asked <= self.answer.high + margin

    def to_json(self) -> dict[str, Any]:
        asked = {key: getattr(self.question, key) for key in ("condition", "quantity", "unit", "asked")}
        before = self.before and asdict(self.before)
        return {"engine": self.engine, **asked, **asdict(self.answer), "ok": self.ok, "before": before}


@dataclass(frozen=True)
class Measured:
    """All rows of one engine, and how late the machine was by itself, in seconds."""

    engine: str
    rows: tuple[Row, ...]
    lateness: Lateness

    @property
    def ok(self) -> bool:
        return all(row.ok for row in self.rows)

    def to_json(self) -> dict[str, Any]:
        """`lateness` in seconds: median and 99th percentile, of packets without conditions on the way and of timers."""
        late = {"way": self.lateness.way_s, "timers": self.lateness.timers_s}
        lateness = {key: {"median_s": median(each), "p99_s": quantiles(each, n=100)[-1]} for key, each in late.items()}
        return {"engine": self.engine, "lateness": lateness, "rows": [row.to_json() for row in self.rows]}


def measure(engine: str, studies: Sequence[Study], observe: Observer, packets: int = PACKETS) -> Measured:
    """Answer every question of the studies; what lies outside is asked once more. Raises what `observe` raises."""
    rows: list[Row] = []
    late: list[Lateness] = []
    for study in studies:
        heard = observe(study, packets)
        late.append(next(iter(heard.values())).lateness)
        answers = [Row(engine, question, _answer(question, heard)) for question in study.questions]
        if outside := tuple(row.question for row in answers if not row.ok):
            again = observe(replace(study, questions=outside), packets)
            answers = [
                row if row.ok else replace(row, answer=_answer(row.question, again), before=row.answer)
                for row in answers
            ]
        rows += answers
    ways, timers = (
        [*chain.from_iterable(values)] for values in zip(*((o.way_s, o.timers_s) for o in late), strict=True)
    )
    return Measured(engine, tuple(rows), Lateness(ways, timers))


def _answer(question: Question, heard: Mapping[tuple[int, int], Heard]) -> Estimate:
    return question.estimate(heard[question.sender, question.receiver])


# What is asked


def studies(engine: str) -> tuple[Study, ...]:
    """All that an engine is asked: "nftables" loss and partitions; "netem" and "medium" everything.

    Duplicates have a study of their own: some kernels want them alone (see `netem.tc`).
    """
    if engine == "nftables":
        return (_receivers(_losses()), _pairs())
    noticed = 1.0 if engine == "medium" else 1 - _UNPROTECTED_BITS / _FRAME_BITS
    return (_receivers([*_losses(), *_rest(noticed)]), _receivers(_duplicates()), _pairs())


@dataclass(frozen=True)
class _Case:
    """One link, and what to ask of it: (quantity, asked, estimate, unit)."""

    condition: str
    link: LinkConditions
    figures: tuple[tuple[str, float, Callable[[Heard], Estimate], str], ...]


def _losses() -> list[_Case]:
    shares = (0.01, 0.05, 0.15, 0.5)
    return [_Case(f"loss {share:g}", LinkConditions(share), (("lost", share, estimates.lost, ""),)) for share in shares]


def _rest(noticed: float) -> list[_Case]:
    """All else but duplicates; `noticed` is the share of corruptions that a receiver notices."""
    bursts = GilbertElliott(p=0.05, r=0.25)
    fixed, jitter_s = Delay(0.1), 0.02
    rate, limit = 500_000.0, 50
    shapes = [Delay(fixed.mean_s, jitter_s, shape) for shape in get_args(Distribution)]
    return [
        _Case(
            f"loss in bursts, p {bursts.p:g}, r {bursts.r:g}",
            LinkConditions(bursts),
            (
                ("lost", bursts.mean, estimates.lost_in_bursts, ""),
                ("mean burst", 1 / bursts.r, estimates.burst_length, "packets"),
            ),
        ),
        _Case("delay 100 ms", LinkConditions(delay=fixed), (("mean", fixed.mean_s, estimates.delay_mean, "s"),)),
        *(_jittered(delay) for delay in shapes),
        _Case(
            "reorder 0.25, delay 100 ms",
            LinkConditions(delay=fixed, reorder=0.25),
            (("came at once", 0.25, partial(estimates.came_at_once, delay_s=fixed.mean_s), ""),),
        ),
        _Case("corrupt 0.2", LinkConditions(corrupt=0.2), (("lost", 0.2 * noticed, estimates.lost, ""),)),
        _Case(
            f"rate {rate / 1000:g} kbit/s",
            LinkConditions(rate=rate),
            (("rate", rate, partial(estimates.rate, packet_bits=_FRAME_BITS), "bit/s"),),
        ),
        _Case(
            f"limit {limit}, delay 100 ms",
            LinkConditions(delay=fixed, limit=limit),
            (("waited", limit, partial(estimates.waiting_when_lost, delay_s=fixed.mean_s), "packets"),),
        ),
    ]


def _jittered(delay: Delay) -> _Case:
    deviations = [entry / SCALE for entry in table(delay.distribution, _TABLE_SIZE)]
    mean_s = delay.mean_s + delay.jitter_s * fmean(deviations)
    deviation_s = delay.jitter_s * pstdev(deviations)
    return _Case(
        f"delay {delay.mean_s * 1000:g} ± {delay.jitter_s * 1000:g} ms {delay.distribution}",
        LinkConditions(delay=delay),
        (("mean", mean_s, estimates.delay_mean, "s"), ("deviation", deviation_s, estimates.delay_deviation, "s")),
    )


def _duplicates() -> list[_Case]:
    return [_Case("duplicate 0.3", LinkConditions(duplicate=0.3), (("came twice", 0.3, estimates.came_twice, ""),))]


def _receivers(cases: Sequence[_Case]) -> Study:
    """One sender, and a receiver for each case."""
    numbered = dict(enumerate(cases, _FIRST_FREE))
    questions = [
        Question(_SENDER, receiver, case.condition, *figure)
        for receiver, case in numbered.items()
        for figure in case.figures
    ]
    conditions = NetworkConditions(receivers={receiver: case.link for receiver, case in numbered.items()})
    return Study(conditions, tuple(questions))


def _pairs() -> Study:
    """Two senders at the same time, a loss for each direction between them and for the rest, and one cut off."""
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
    return Study(
        conditions.with_partition([[cut]]),
        (
            Question(_SENDER, _OTHER_SENDER, asked, "lost there", there, estimates.lost),
            Question(_OTHER_SENDER, _SENDER, asked, "lost back", back, estimates.lost),
            Question(_SENDER, bystander, asked, "lost elsewhere", rest, estimates.lost),
            Question(_SENDER, cut, "partition", "passed", 0.0, estimates.passed),
        ),
    )

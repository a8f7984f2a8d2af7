"""Model the probability that a message arrives as a function of the distance. Fit the model to data by maximum
likelihood.

A receiver at d metres gets a message with probability

    (1 - floor) * exp(-load * others) * Phi(ln(range / d) / spread)

- `range_m` is the distance at which path loss and shadowing lose half of the messages.
- `spread` is the standard deviation of the shadowing, in units of ln(distance).
- `floor` is the loss rate that does not depend on the distance.

- `load` determines the loss by the messages of other vehicles on the air at about the same time. `others` is the number
  of these messages.

The last factor is the model `log_distance` of a scenario. The deliveries do not determine all its parameters. Transmit
power, sensitivity and the loss of the first metre have the same effect, so `range_m` stands for all of them. If the
exponent and the shadowing in dB are both doubled, the delivery does not change, so `spread` stands for both: the
shadowing is `10 / ln(10) * exponent * spread` dB. The caller must know the exponent, for example from signal strengths.

Messages over one link are correlated, because a building or a wing shadows many of them. Intervals that assume
independent messages would be too short. The transmissions are therefore divided into clusters, and each interval comes
from the jackknife over clusters: the model is fitted without each cluster in turn, in one step of Newton's method
(Cameron and Miller, Journal of Human Resources 50(2), 2015, section VI.B). This is done with two kinds of clusters:
links in blocks of time, and whole links. The wider interval counts. A bootstrap over clusters would need hundreds of
fits, and would be less accurate with few clusters.

`floor` and `load` can be zero, so their intervals are profile likelihood intervals. The threshold of these intervals is
scaled by the ratio of the jackknife variance to the variance of independent messages.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from statistics import NormalDist
from typing import NamedTuple

BLOCK_S = 120.0
"""Length in seconds of the blocks of time into which the messages of a link are divided."""
MIN_DISTANCE_M = 1.0
LEVEL = 0.95
PARAMETERS = ("range_m", "spread", "floor", "load")

_STEPS_PER_FOLD = 50
"""Distances are divided into steps, each longer than the previous one by the same factor. This is the number of steps
between a distance and e (2.718) times this distance. Transmissions with distances in the same step are counted
together.
"""
_MOST_ITERATIONS = 60
_LEAST = 1e-9
_LOWEST = (math.log(1.0), math.log(0.02), 0.0, 0.0)
_HIGHEST = (math.log(1e6), math.log(5.0), 7.0, 7.0)
_NORMAL = NormalDist()

Vector = list[float]


class TransmissionAttempt(NamedTuple):
    """The transmission of a message to one receiver, at mission second `at_s`."""

    at_s: float
    sender: int
    receiver: int
    distance_m: float
    delivered: bool
    others: int = 0
    """Number of messages from other vehicles that were on the air at about the same time."""

    @property
    def link(self) -> frozenset[int]:
        return frozenset((self.sender, self.receiver))


@dataclass(frozen=True)
class DeliveryModel:
    """The parameters of the delivery model. The docstring of this module explains them."""

    range_m: float
    spread: float
    floor: float = 0.0
    load: float = 0.0

    def delivery(self, distance_m: float, others: int = 0) -> float:
        """Return the probability that a message arrives over this distance, with `others` messages on the air at the
        same time.
        """
        deviation = math.log(self.range_m / max(distance_m, MIN_DISTANCE_M)) / self.spread
        return (1 - self.floor) * math.exp(-self.load * others) * _phi(deviation)

    @property
    def wide(self) -> float:
        """Return the distance at which 10 % of the messages arrive, divided by the distance at which 90 % arrive.
        `floor` is treated as 0.
        """
        return math.exp(2 * _NORMAL.inv_cdf(0.9) * self.spread)


class ConfidenceInterval(NamedTuple):
    """A confidence interval with the confidence level `LEVEL`."""

    low: float
    high: float

    def __contains__(self, value: object) -> bool:
        return isinstance(value, int | float) and self.low <= value <= self.high


@dataclass(frozen=True)
class FittedModel:
    """A fitted model. `intervals` contains a confidence interval for each fitted parameter, by name."""

    model: DeliveryModel
    intervals: dict[str, ConfidenceInterval]
    attempts: int
    clusters: int
    log_likelihood: float
    constant_log_likelihood: float
    """Log likelihood of a model with the same loss rate for all messages."""


class _TransmissionCluster(NamedTuple):
    """Transmissions over one link in one block of time whose distances are about the same: the number of attempts, and
    the number of messages that arrived. `log_m` is the logarithm of the distance in metres.
    """

    log_m: float
    others: int
    attempts: int
    delivered: int
    block: Hashable
    link: Hashable


def fit(attempts: Sequence[TransmissionAttempt]) -> FittedModel | None:
    """Fit the model to transmissions. Return None if the transmissions do not determine the range and the spread.

    This is the case if all or no messages arrived, or if the distances hardly differ.
    """
    rows = _rows(attempts)
    cells = _cells(rows)
    delivered = sum(row.delivered for row in rows)
    if not 0 < delivered < len(attempts):
        return None
    if max(row.log_m for row in rows) - min(row.log_m for row in rows) < math.log(1.2):
        return None
    free = [0, 1, 2, *([3] if len({row.others for row in rows}) > 1 else [])]
    values, likelihood = max((_maximise(cells, start, free) for start in _starts(rows, free)), key=itemgetter(1))
    if not _LOWEST[0] < values[0] < _HIGHEST[0] - 1 or values[1] > _HIGHEST[1] - 0.01:
        return None
    constant = _constant_likelihood(delivered, len(attempts))
    scales, freedom, clusters = _cluster_scales(rows, values, free)
    model = _model(values)
    intervals = _intervals(cells, values, likelihood, free, scales, freedom)
    return FittedModel(model, intervals, len(attempts), clusters, likelihood, constant)


def _rows(attempts: Iterable[TransmissionAttempt]) -> list[_TransmissionCluster]:
    counts: dict[tuple[int, int, frozenset[int], int], list[int]] = defaultdict(lambda: [0, 0])
    for attempt in attempts:
        step = round(_STEPS_PER_FOLD * math.log(max(attempt.distance_m, MIN_DISTANCE_M)))
        count = counts[step, attempt.others, attempt.link, int(attempt.at_s // BLOCK_S)]
        count[0] += 1
        count[1] += attempt.delivered
    return [
        _TransmissionCluster(step / _STEPS_PER_FOLD, others, attempts_here, delivered, (link, block), link)
        for (step, others, link, block), (attempts_here, delivered) in counts.items()
    ]


def _cells(rows: Iterable[_TransmissionCluster]) -> list[_TransmissionCluster]:
    """Combine transmissions with similar distances, even if they belong to different clusters. The combined
    transmissions have the same likelihood, but fewer terms must be computed.
    """
    counts: dict[tuple[float, int], list[int]] = defaultdict(lambda: [0, 0])
    for row in rows:
        count = counts[row.log_m, row.others]
        count[0] += row.attempts
        count[1] += row.delivered
    return [
        _TransmissionCluster(log_m, others, number, delivered, None, None)
        for (log_m, others), (number, delivered) in counts.items()
    ]


def _starts(rows: Sequence[_TransmissionCluster], free: Sequence[int]) -> list[Vector]:
    distances = sorted(row.log_m for row in rows)
    load = 0.01 if 3 in free else 0.0
    return [
        [distances[int(share * (len(distances) - 1))] + further, math.log(spread), 0.02, load]
        for share in (0.4, 0.95)
        for further, spread in ((0.0, 0.3), (0.5, 0.8))
    ]


def _terms(row: _TransmissionCluster, values: Vector) -> tuple[float, Vector]:
    """Return the probability that a transmission arrives, and the derivatives of this probability with respect to the
    parameters.
    """
    spread = math.exp(values[1])
    deviation = (values[0] - row.log_m) / spread
    survives = math.exp(-values[2] - values[3] * row.others)
    density = survives * math.exp(-0.5 * deviation * deviation) / math.sqrt(2 * math.pi)
    probability = survives * _phi(deviation)
    return min(max(probability, _LEAST), 1 - _LEAST), [
        density / spread,
        -density * deviation,
        -probability,
        -row.others * probability,
    ]


def _likelihood(rows: Iterable[_TransmissionCluster], values: Vector) -> float:
    spread = math.exp(values[1])
    total = 0.0
    for row in rows:
        probability = math.exp(-values[2] - values[3] * row.others) * _phi((values[0] - row.log_m) / spread)
        probability = min(max(probability, _LEAST), 1 - _LEAST)
        total += row.delivered * math.log(probability)
        total += (row.attempts - row.delivered) * math.log1p(-probability)
    return total


def _score(rows: Iterable[_TransmissionCluster], values: Vector, free: Sequence[int]) -> tuple[Vector, list[Vector]]:
    """Return the score vector and the expected information matrix of the likelihood, for the free parameters."""
    score = [0.0] * len(free)
    information = [[0.0] * len(free) for _ in free]
    for row in rows:
        probability, derivatives = _terms(row, values)
        weight = 1 / (probability * (1 - probability))
        residual = (row.delivered - row.attempts * probability) * weight
        for place, parameter in enumerate(free):
            score[place] += residual * derivatives[parameter]
            for other in range(place + 1):
                information[place][other] += row.attempts * weight * derivatives[parameter] * derivatives[free[other]]
    for place in range(len(free)):
        for other in range(place):
            information[other][place] = information[place][other]
    return score, information


def _maximise(rows: Sequence[_TransmissionCluster], start: Vector, free: Sequence[int]) -> tuple[Vector, float]:
    """Maximise the likelihood over the free parameters by Fisher scoring within their limits."""
    values = [*start]
    likelihood = _likelihood(rows, values)
    for _ in range(_MOST_ITERATIONS):
        slopes, information = _score(rows, values, free)
        inner = [
            place
            for place, parameter in enumerate(free)
            if not (values[parameter] <= _LOWEST[parameter] and slopes[place] < 0)
            and not (values[parameter] >= _HIGHEST[parameter] and slopes[place] > 0)
        ]
        active = [free[place] for place in inner]
        step = _solve(
            [[information[one][other] for other in inner] for one in inner], [slopes[place] for place in inner]
        )
        if step is None:
            break
        share, gained = 1.0, False
        while share > 1e-4 and not gained:
            tried = [*values]
            for parameter, change in zip(active, step, strict=True):
                change = max(-1.0, min(1.0, share * change))
                tried[parameter] = min(max(values[parameter] + change, _LOWEST[parameter]), _HIGHEST[parameter])
            tried_likelihood = _likelihood(rows, tried)
            gained = tried_likelihood > likelihood
            share /= 2
        if not gained:
            break
        values, gain, likelihood = tried, tried_likelihood - likelihood, tried_likelihood
        if gain < 1e-7:
            break
    return values, likelihood


def _cluster_scales(
    rows: Sequence[_TransmissionCluster], values: Vector, free: Sequence[int]
) -> tuple[dict[int, tuple[float, float]], dict[int, float], int]:
    """Compute the standard errors of the free parameters. Return three results. The first maps each parameter to two
    standard errors, with clusters and without. The second maps each parameter to its degrees of freedom. The third is
    the number of clusters (links in blocks of time).
    """
    inner = [parameter for parameter in free if values[parameter] > _LOWEST[parameter]]
    _, information = _score(rows, values, inner)
    inverse = _inverse(information)
    scales: dict[int, tuple[float, float]] = {}
    freedom: dict[int, float] = {}
    number = 0
    if inverse is None:
        return scales, freedom, number
    key: Callable[[_TransmissionCluster], Hashable]
    for key in (lambda row: row.block, lambda row: row.link):
        clusters: dict[Hashable, list[_TransmissionCluster]] = defaultdict(list)
        for row in rows:
            clusters[key(row)].append(row)
        number = number or len(clusters)
        if len(clusters) < 3:
            continue
        variances = [0.0] * len(inner)
        weights: list[Vector] = [[] for _ in inner]
        for cluster in clusters.values():
            score, own = _score(cluster, values, inner)
            rest = [[a - b for a, b in zip(x, y, strict=True)] for x, y in zip(information, own, strict=True)]
            change = _solve(rest, score) or [10.0] * len(inner)
            for place, moved in enumerate(change):
                variances[place] += moved * moved * (len(clusters) - 1) / len(clusters)
                weights[place].append(own[place][place])
        for place, parameter in enumerate(inner):
            error = math.sqrt(variances[place])
            if error > scales.get(parameter, (0.0, 0.0))[0]:
                scales[parameter] = error, math.sqrt(inverse[place][place])
                total, squares = sum(weights[place]), sum(weight * weight for weight in weights[place])
                freedom[parameter] = max(total * total / squares - 1, 1.0) if squares else 1.0
    for place, parameter in enumerate(inner):
        independent = math.sqrt(inverse[place][place])
        if parameter not in scales or scales[parameter][0] < independent:
            scales[parameter], freedom[parameter] = (independent, independent), freedom.get(parameter, 3.0)
    return scales, freedom, number


def _intervals(
    rows: Sequence[_TransmissionCluster],
    values: Vector,
    likelihood: float,
    free: Sequence[int],
    scales: Mapping[int, tuple[float, float]],
    freedom: Mapping[int, float],
) -> dict[str, ConfidenceInterval]:
    intervals = {}
    for parameter in free:
        if parameter < 2:
            half = student(freedom.get(parameter, 3.0)) * scales.get(parameter, (10.0, 10.0))[0]
            half = min(half, 20.0)
            intervals[PARAMETERS[parameter]] = ConfidenceInterval(
                math.exp(values[parameter] - half), math.exp(values[parameter] + half)
            )
            continue
        ratios = [(scales[each][0] / scales[each][1]) ** 2 for each in scales if each in (parameter, 0)]
        quantile = student(freedom.get(parameter, freedom.get(0, 3.0)))
        most = 0.5 * quantile * quantile * max([1.0, *ratios])
        low, high = _profile(rows, values, likelihood - most, free, parameter)
        intervals[PARAMETERS[parameter]] = (
            ConfidenceInterval(1 - math.exp(-low), 1 - math.exp(-high))
            if parameter == 2
            else ConfidenceInterval(low, high)
        )
    return intervals


def _profile(
    rows: Sequence[_TransmissionCluster], values: Vector, least: float, free: Sequence[int], parameter: int
) -> tuple[float, float]:
    """Return the lowest and the highest value of a parameter at which its profile likelihood is at least `least`."""
    others = [each for each in free if each != parameter]

    def inside(value: float) -> bool:
        start = [*values]
        start[parameter] = value
        return _maximise(rows, start, others)[1] >= least

    bounds = []
    for limit in (_LOWEST[parameter], _HIGHEST[parameter]):
        near, far = values[parameter], limit
        if inside(far):
            bounds.append(far)
            continue
        for _ in range(14):
            middle = (near + far) / 2
            near, far = (middle, far) if inside(middle) else (near, middle)
        bounds.append((near + far) / 2)
    return bounds[0], bounds[1]


def student(freedom: float) -> float:
    """Return the quantile of Student's t for a two-sided interval at `LEVEL` (Abramowitz and Stegun, 26.7.5).

    The series is exact to 0.1 % from 3 degrees of freedom on. Fewer degrees of freedom count as 3.
    """
    nu, z = max(freedom, 3.0), _NORMAL.inv_cdf(0.5 + LEVEL / 2)
    return (
        z
        + (z**3 + z) / (4 * nu)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * nu**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * nu**3)
        + (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / (92160 * nu**4)
    )


def wilson(delivered: float, attempts: float) -> ConfidenceInterval:
    """Return Wilson's confidence interval of the probability that a message arrives, if `delivered` of `attempts`
    independent messages arrived (Wilson, JASA 22, 1927). If there are no attempts, the interval is 0 to 1.
    """
    if not attempts:
        return ConfidenceInterval(0.0, 1.0)
    z = _NORMAL.inv_cdf(0.5 + LEVEL / 2)
    share, extra = delivered / attempts, z * z / attempts
    middle = (share + extra / 2) / (1 + extra)
    half = z * math.sqrt(share * (1 - share) / attempts + extra / (4 * attempts)) / (1 + extra)
    return ConfidenceInterval(max(0.0, middle - half), min(1.0, middle + half))


def _constant_likelihood(delivered: int, attempts: int) -> float:
    share = delivered / attempts
    return delivered * math.log(share) + (attempts - delivered) * math.log1p(-share)


def _model(values: Vector) -> DeliveryModel:
    return DeliveryModel(math.exp(values[0]), math.exp(values[1]), 1 - math.exp(-values[2]), values[3])


def _phi(deviation: float) -> float:
    return 0.5 * math.erfc(-deviation / math.sqrt(2))


def _solve(matrix: Sequence[Sequence[float]], right: Sequence[float]) -> Vector | None:
    """Solve linear equations by elimination. Return None if the matrix is singular."""
    size = len(right)
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for column in range(size):
        pivot = max(range(column, size), key=lambda row: abs(rows[row][column]))
        if abs(rows[pivot][column]) < 1e-12:
            return None
        rows[column], rows[pivot] = rows[pivot], rows[column]
        for row in range(size):
            if row != column:
                factor = rows[row][column] / rows[column][column]
                rows[row] = [a - factor * b for a, b in zip(rows[row], rows[column], strict=True)]
    return [rows[row][size] / rows[row][row] for row in range(size)]


def _inverse(matrix: Sequence[Sequence[float]]) -> list[Vector] | None:
    columns = []
    for place in range(len(matrix)):
        column = _solve(matrix, [float(place == other) for other in range(len(matrix))])
        if column is None:
            return None
        columns.append(column)
    return columns

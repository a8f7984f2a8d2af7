"""Compute tables of quantiles for the delay distributions of tc-netem(8). The tables have the format that netem reads.

netem draws an entry of a table and multiplies it by the jitter. iproute2 contains such tables as files (normal.dist,
pareto.dist, paretonormal.dist), but not every machine has them. This module therefore computes the tables.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

from netem.link import Distribution

SCALE = 8192
"""Unit of a table entry. In the uniform distribution, an entry of SCALE means the largest deviation from the mean. In
the other distributions, it means one standard deviation above the mean.
"""


@cache
def table(distribution: Distribution, size: int) -> tuple[int, ...]:
    """Return `size` equally probable quantiles in ascending order, as signed 16-bit numbers.

    The Pareto distribution has shape 3 and is shifted to mean 0. A value of `paretonormal` is the sum of a quarter of a
    normal value and three quarters of a Pareto value.
    """
    at = [(index + 0.5) / size for index in range(size)]
    normal = [NormalDist().inv_cdf(share) for share in at]
    pareto = [((1 - share) ** (-1 / 3) - 1.5) * 4 / 3 for share in at]
    deviations = {
        "uniform": [2 * share - 1 for share in at],
        "normal": normal,
        "pareto": pareto,
        "paretonormal": [0.25 * n + 0.75 * p for n, p in zip(normal, pareto, strict=True)],
    }[distribution]
    return tuple(min(round(deviation * SCALE), 32767) for deviation in deviations)

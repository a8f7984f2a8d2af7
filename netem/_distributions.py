"""Compute the quantiles of the delay distributions in tc-netem(8), in the form of netem's own tables.

netem draws an entry of a table and multiplies it by the jitter. iproute2 contains such tables as files (normal.dist,
pareto.dist, paretonormal.dist), but not every machine has them. This module therefore computes the tables.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

from netem.link import Distribution

SCALE = 8192
"""Unit of a table entry. An entry is a multiple of 1/SCALE of a standard deviation. In the uniform distribution, it is
a multiple of 1/SCALE of half the width.
"""


@cache
def table(distribution: Distribution, size: int) -> tuple[int, ...]:
    """Return `size` equally probable quantiles in ascending order, as signed 16-bit numbers.

    The Pareto distribution has shape 3 and is shifted to mean 0. The distribution `paretonormal` is a quarter normal
    and three quarters Pareto.
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

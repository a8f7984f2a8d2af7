"""How delays vary: quantiles of tc-netem(8)'s distributions, in the form of netem's own tables.

netem draws an entry of a table and multiplies it with the jitter. iproute2 has such tables as files (normal.dist,
pareto.dist, paretonormal.dist), which not every machine has: ours are computed.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

from netem.link import Distribution

SCALE = 8192
"""Entries are in 1/SCALE of a standard deviation (of the uniform one: of half the width)."""


@cache
def table(distribution: Distribution, size: int) -> tuple[int, ...]:
    """`size` quantiles, equally probable, ascending, as whole numbers of 16 bits with a sign.

    Pareto is that of shape 3, shifted to mean 0; the mixed one is a quarter normal and three quarters Pareto.
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

"""Test the fit of power laws whose exponents are known."""

import math
from random import Random

import pytest

from harness.sweep.matrix._growth import Variable, fit

AGENTS: list[Variable] = ["agents"]
BOTH: list[Variable] = ["agents", "blocks"]


@pytest.mark.parametrize("exponent", [-1.0, 0.0, 0.5, 1.0, 2.0, 3.3])
def test_a_law_without_noise_is_found_as_it_is(exponent: float) -> None:
    law = fit(AGENTS, [([n], 0.7 * n**exponent) for n in (5, 10, 20, 50, 200)])
    assert law
    found = law.exponents["agents"]
    assert (found.value, found.low, found.high) == pytest.approx((exponent,) * 3, abs=1e-6)
    assert law.factor == pytest.approx(0.7, rel=1e-5)
    assert law.r_squared == (None if exponent == 0 else pytest.approx(1))
    assert (law.n, law.left_out) == (5, 0)


def test_fit_separates_two_variables() -> None:
    law = fit(BOTH, [([n, n * m], 2 * n**1.5 * (n * m) ** 0.8) for n in (5, 20, 80) for m in (3, 6, 12)])
    assert law
    assert law.exponents["agents"].value == pytest.approx(1.5)
    assert law.exponents["blocks"].value == pytest.approx(0.8)
    assert law.factor == pytest.approx(2)
    assert law.r_squared == pytest.approx(1)


@pytest.mark.parametrize("variables", [AGENTS, BOTH])
def test_in_noise_nineteen_intervals_of_twenty_hold_the_exponent(variables: list[Variable]) -> None:
    random = Random(1)
    trials, held = 400, 0
    for _ in range(trials):
        sizes = [(n, n * m) for n in (5, 10, 20, 50) for m in (1, 2, 4)]
        points = [
            ((n, b)[: len(variables)], 4 * n**2 * math.exp(random.gauss(0, 0.3)) * (b if len(variables) > 1 else 1))
            for n, b in sizes
        ]
        law = fit(variables, points)
        assert law
        held += law.exponents["agents"].low <= 2 <= law.exponents["agents"].high
    assert 0.91 <= held / trials <= 0.99


def test_the_interval_is_that_of_a_worked_example() -> None:
    """The logarithms are x = 1 to 5 and y = 2, 4, 5, 4, 5. The slope is 0.6, the standard error sqrt(0.08), and t is
    3.1824.
    """
    law = fit(AGENTS, [([math.exp(x)], math.exp(y)) for x, y in zip(range(1, 6), (2, 4, 5, 4, 5), strict=True)])
    assert law
    found = law.exponents["agents"]
    assert found.value == pytest.approx(0.6)
    assert found.high - found.value == pytest.approx(3.1824463 * math.sqrt(0.08), rel=1e-5)
    assert law.r_squared == pytest.approx(0.6)


def test_points_without_logarithm_are_left_out_and_counted() -> None:
    law = fit(AGENTS, [([n], y) for n, y in ((1, 1), (2, 4), (4, 16), (8, 0), (16, -3), (0, 5))])
    assert law
    assert (law.n, law.left_out) == (3, 3)
    assert law.exponents["agents"].value == pytest.approx(2)


@pytest.mark.parametrize(
    ("variables", "points"),
    [
        (AGENTS, []),
        (AGENTS, [([5.0], 1.0), ([10.0], 2.0)]),
        (AGENTS, [([5.0], 1.0), ([5.0], 2.0), ([5.0], 3.0)]),
        (AGENTS, [([5.0], 0.0), ([10.0], 0.0), ([20.0], 0.0)]),
        (BOTH, [([n, 3 * n], 2.0 * n) for n in (5.0, 10.0, 20.0, 40.0)]),
        (BOTH, [([5.0, b], 2.0 * b) for b in (5.0, 10.0, 20.0, 40.0)]),
        (BOTH, [([n, 7.0], 2.0 * n) for n in (5.0, 10.0, 20.0, 40.0)]),
    ],
    ids=["nothing", "two points", "one size", "no messages", "two as one", "one number of agents", "one of blocks"],
)
def test_fit_finds_no_law_in_unsuitable_points(
    variables: list[Variable], points: list[tuple[list[float], float]]
) -> None:
    assert fit(variables, points) is None

"""Test confidence intervals against published values."""

import math

import pytest

from harness.sweep.matrix._estimate import Estimate, estimate_mean, estimate_share, student_quantile


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [(1, 12.7062047), (2, 4.3026527), (3, 3.1824463), (4, 2.7764451), (9, 2.2621572), (10, 2.2281389),
     (30, 2.0422725), (99, 1.9842170), (199, 1.9719565), (1000, 1.9623391), (9999, 1.9602012)],
)  # fmt: skip
def test_student_quantile_equals_the_published_table(degrees: int, expected: float) -> None:
    assert student_quantile(0.975, degrees) == pytest.approx(expected, abs=1e-7)


def test_mean_has_students_interval() -> None:
    estimate = estimate_mean([4.0, 5.0, 6.0, 7.0])
    margin = 3.1824463 * math.sqrt(5 / 3) / 2
    assert (estimate.n, estimate.mean) == (4, 5.5)
    assert estimate.low == pytest.approx(5.5 - margin)
    assert estimate.high == pytest.approx(5.5 + margin)


def test_equal_values_have_an_interval_without_width() -> None:
    assert estimate_mean([5.0] * 7) == Estimate(n=7, mean=5.0, low=5.0, high=5.0)


@pytest.mark.parametrize(
    ("count", "n", "low", "high"),
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (5, 10, 0.2366, 0.7634), (81, 263, 0.2553, 0.3662),
     (200, 200, 0.9812, 1.0)],
)  # fmt: skip
def test_share_has_wilsons_interval(count: int, n: int, low: float, high: float) -> None:
    estimate = estimate_share(count, n)
    assert estimate.mean == count / n
    assert (estimate.low, estimate.high) == (pytest.approx(low, abs=5e-5), pytest.approx(high, abs=5e-5))


def test_one_run_has_no_interval_and_no_run_has_no_mean() -> None:
    assert estimate_mean([3.0]) == Estimate(n=1, mean=3.0)
    assert estimate_share(1, 1) == Estimate(n=1, mean=1.0)
    assert estimate_mean([]) == estimate_share(0, 0) == Estimate(n=0)

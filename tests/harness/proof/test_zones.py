"""Compare sets of remaining timer values (zones) with all possible times on a grid."""

from itertools import product
from random import Random

from harness.proof.examples._path_times import TimerRun, instants_s
from harness.proof.model._zones import NOTHING_RUNS, ZoneTable

DURATIONS = (10, 5)


def test_zones_contain_exactly_the_possible_times() -> None:
    """Timers start and expire at random. Whole time units are enough, because all bounds are whole numbers."""
    for seed in range(30):
        lots, zones = Random(seed), ZoneTable()
        zone, points = NOTHING_RUNS, {()}
        for _ in range(8):
            running = len(next(iter(points)))
            may_end = {index + 1 for point in points for index, left in enumerate(point) if left == min(point)}
            assert set(zones.firsts(zone)) == may_end
            ended = tuple(sorted(lots.sample(sorted(may_end), 1))) if may_end and lots.random() < 0.6 else ()
            stay = [timer for timer in range(1, running + 1) if timer not in ended]
            new = [lots.choice(DURATIONS)] if len(stay) < 3 else []
            zone_after = zones.after(zone, ended, (*stay, *(-duration - 1 for duration in new)))
            assert zone_after is not None
            zone = zone_after
            points = {
                tuple(left - passed for left in after)
                for point in points
                if all(point[timer - 1] == 0 for timer in ended)
                for after in [(*(point[timer - 1] for timer in stay), *new)]
                for passed in range(min(after, default=0) + 1)
            }
            assert points == set(inside(zones, zone, len(stay) + len(new)))


def test_zone_finds_timers_that_expire_at_the_same_moment() -> None:
    zones = ZoneTable()
    zone = zones.after(NOTHING_RUNS, (), (-11, -11))
    assert zone is not None
    assert zones.tied(zone) == [(0, 1), (0, 1)]
    apart = zones.after(zone, (), (1, 2, -6))  # the third timer was started at any later time
    assert apart is not None
    assert zones.tied(apart) == [(0, 1), (0, 1), (2,)]


def inside(zones: ZoneTable, zone: int, timers: int) -> list[tuple[int, ...]]:
    """Return the points of a zone with integer coordinates."""
    matrix = zones.matrix(zone)
    found = []
    for point in product(range(max(DURATIONS) + 1), repeat=timers):
        times = (0, *point)
        if all(times[i] - times[j] <= matrix[i][j] for i in range(timers + 1) for j in range(timers + 1)):
            found.append(point)
    return found


def test_instants_have_the_largest_possible_distance() -> None:
    assert instants_s(3, [TimerRun(0, 10, 2, True)]) == [1, 6, 11]
    assert instants_s(3, [TimerRun(0, 10, 1, True), TimerRun(1, 5, 2, True)]) == [1, 11, 16]
    assert instants_s(3, [TimerRun(0, 10, 2, True), TimerRun(1, 10, 2, True)]) == [1, 1, 11]


def test_only_timers_in_any_order_may_be_late() -> None:
    assert instants_s(3, [TimerRun(0, 10, 1, True), TimerRun(0, 5, 2, True)]) == [1, 11, 16]

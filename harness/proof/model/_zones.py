"""Store the possible remaining times of all running timers as zones (difference bounds matrices), and give each zone a
number.

A zone is a set of possible remaining times of n timers: all times with x_i - x_j <= m[i][j], where x_0 = 0. The matrix
is closed (no bound can be tightened), so equal sets have equal matrices. In a stored zone, any amount of time may have
passed: with each point it contains all later points until the first expiry. Bounds are whole microseconds between minus
and plus the longest duration, so their number is finite.

The number of zones can still be large. If two groups of agents repeat cycles whose periods differ by 0.1 s, their
relative times shift by 0.1 s in each round, and each round has new zones. Most of these zones are contained in the zone
of the first round (`ZoneTable.contains`, option `--zones contained`). With widened zones, a proof would need fewer
states, but its paths might be impossible as runs.
"""

from collections.abc import Sequence

Matrix = tuple[tuple[int, ...], ...]
NOTHING_RUNS = 0
EVER_US = 10**15
"""A number of microseconds that is longer than the duration of any timer."""


class ZoneTable:
    """All zones by number, with cached results of their operations. A zone is a set of possible remaining times of
    timers.
    """

    def __init__(self) -> None:
        self._matrices: list[Matrix] = []
        self._numbers: dict[Matrix, int] = {}
        self._after: dict[tuple[int, tuple[int, ...], tuple[int, ...]], int | None] = {}
        self._tied: dict[int, list[tuple[int, ...]]] = {}
        self._bounds: dict[int, list[tuple[int, ...]]] = {}
        self._permuted: dict[tuple[int, tuple[int, ...]], int] = {}
        self._adrift: dict[int, int] = {}
        self._coincidences: dict[tuple[int, tuple[int, ...]], int] = {}
        self._intern(((0,),))

    def __len__(self) -> int:
        return len(self._matrices)

    def matrix(self, zone: int) -> Matrix:
        return self._matrices[zone]

    def contains(self, zone: int, other: int) -> bool:
        """Return true if all times of the zone `other` also lie in `zone`. Both zones have the same timers."""
        return all(
            there <= here
            for row, other_row in zip(self._matrices[zone], self._matrices[other], strict=True)
            for here, there in zip(row, other_row, strict=True)
        )

    def adopt(self, matrix: Matrix) -> int:
        """Return the number of a zone that a different process found."""
        return self._intern(matrix)

    def firsts(self, zone: int) -> list[int]:
        """Return the timers that may expire next. Timers are numbered from 1."""
        least = self._matrices[zone][0]
        return [timer for timer in range(1, len(least)) if not least[timer]]

    def no_time_passes(self, zone: int) -> bool:
        """Return true if the next timer must expire at the same moment as the previous expiry."""
        return any(row[0] == 0 for row in self._matrices[zone][1:])

    def tied(self, zone: int) -> list[tuple[int, ...]]:
        """Return, for each timer that may expire next, the indices of the timers that must expire together with it."""
        tied = self._tied.get(zone)
        if tied is None:
            firsts = self.firsts(zone)
            ended = [self._ended(zone, (timer,)) for timer in firsts]
            tied = self._tied[zone] = [
                tuple(index for index, other in enumerate(firsts) if matrix is not None and not matrix[other][0])
                for matrix in ended
            ]
        return tied

    def bounds(self, zone: int) -> list[tuple[int, ...]]:
        """Describe each timer by its smallest and its largest possible remaining time. The descriptions do not depend
        on the order of the timers.
        """
        bounds = self._bounds.get(zone)
        if bounds is None:
            matrix = self._matrices[zone]
            bounds = self._bounds[zone] = [
                (row[0], matrix[0][timer], *sorted(row), *sorted(other[timer] for other in matrix))
                for timer, row in enumerate(matrix)
            ]
        return bounds

    def after(self, zone: int, ended: tuple[int, ...], running: tuple[int, ...]) -> int | None:
        """Return the zone after all timers in `ended` have expired at the same moment. Return None if they cannot
        expire together.

        For each timer that runs afterwards, `running` contains its previous number. For a timer that was just started,
        it contains -1 minus the duration in microseconds.
        """
        key = zone, ended, running
        if key not in self._after:
            self._after[key] = self._work_out(zone, ended, running)
        return self._after[key]

    def permuted(self, zone: int, places: tuple[int, ...]) -> int:
        """Return the zone with its timers in a new order. `places` contains the previous number of each timer."""
        key = zone, places
        if key not in self._permuted:
            matrix, order = self._matrices[zone], (0, *places)
            self._permuted[key] = self._intern(tuple(tuple(matrix[i][j] for j in order) for i in order))
        return self._permuted[key]

    def adrift(self, zone: int) -> int:
        """Return the zone with the same differences between the timers, and with any remaining time until the first
        expiry. The result represents many zones if no other event can happen before the first expiry, because the time
        until then has no effect.
        """
        if zone not in self._adrift:
            matrix = [list(row) for row in self._matrices[zone]]
            for timer in range(1, len(matrix)):
                matrix[timer][0] = EVER_US + min(matrix[timer][1:])
                matrix[0][timer] = min(0, *(row[timer] for row in matrix[1:]))
            self._adrift[zone] = self._intern(tuple(map(tuple, matrix)))
        return self._adrift[zone]

    def coincidences(self, zone: int, ended: tuple[int, ...]) -> int:
        """Return the number of coincidences that are needed for these timers to expire next and at the same moment. The
        timers must be able to expire at the same time.

        Timers whose differences are fixed form a group. If timers of different groups expire at the same moment, this
        is a coincidence, and the groups merge. The result is the number by which the number of groups decreases.
        """
        key = zone, ended
        if key not in self._coincidences:
            before = self._matrices[zone]
            after = self._ended(zone, ended)
            assert after is not None, "these timers can end at once"
            timers = range(1, len(before))
            self._coincidences[key] = _count_independent_groups(before, timers) - _count_independent_groups(
                after, range(len(before))
            )
        return self._coincidences[key]

    def _ended(self, zone: int, ended: Sequence[int]) -> list[list[int]] | None:
        """Return the bounds of all timers at the moment at which these timers expire first. Return None if this moment
        is impossible.
        """
        matrix = [list(row) for row in self._matrices[zone]]
        size = range(len(matrix))
        for timer in ended:
            if matrix[0][timer] < 0:
                return None
            matrix[timer][0] = 0
            for i in size:  # a path over the new bound may be shorter
                for j in size:
                    over = matrix[i][timer] + matrix[0][j]
                    if over < matrix[i][j]:
                        matrix[i][j] = over
            if any(matrix[i][i] < 0 for i in size):
                return None
        return matrix

    def _work_out(self, zone: int, ended: Sequence[int], running: Sequence[int]) -> int | None:
        matrix = self._ended(zone, ended)
        if matrix is None:
            return None
        places = [0, *running]

        def bound(left: int, right: int) -> int:
            """Return the upper bound of x_left - x_right. The remaining time of a newly started timer is its complete
            duration.
            """
            left_s, left_place = (0, left) if left >= 0 else (-left - 1, 0)
            right_s, right_place = (0, right) if right >= 0 else (-right - 1, 0)
            return left_s - right_s + matrix[left_place][right_place]

        after = [[bound(left, right) for right in places] for left in places]
        for timer in range(1, len(places)):
            after[0][timer] = min(0, *(after[other][timer] for other in range(1, len(places))))
        return self._intern(tuple(map(tuple, after)))

    def _intern(self, matrix: Matrix) -> int:
        number = self._numbers.setdefault(matrix, len(self._matrices))
        if number == len(self._matrices):
            self._matrices.append(matrix)
        return number


def _count_independent_groups(matrix: Sequence[Sequence[int]], timers: range) -> int:
    """Return the number of groups of timers. In a group, the differences of the remaining times are fixed."""
    return sum(
        not any(matrix[timer][other] + matrix[other][timer] == 0 for other in timers if other < timer)
        for timer in timers
    )

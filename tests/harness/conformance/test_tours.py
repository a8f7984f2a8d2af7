"""Ways to the vectors that are yet to be seen."""

import asyncio
import time

from harness.conformance._alphabet import Input
from harness.conformance._observation import Exchange, Seen
from harness.conformance._state_space import VARIANTS, Variant, advance, explore, pair_of, state_of
from harness.conformance._subject import Subject
from harness.conformance._suite import Suite
from harness.conformance._tours import Map
from harness.conformance.vectors import Vectors


def test_what_there_was_not_is_not_tried_again_in_the_same_place() -> None:
    """Everybody has voted, say: then no other way leads to the vector from there, and a tour goes on elsewhere."""
    variant = VARIANTS["default"]
    steps = list(explore(variant))
    wanted = next(step for step in steps if step.pair.input == "vote no" and not step.pair.counted)
    atlas = Map(variant, steps, {wanted.pair})
    assert atlas.unseen_in(wanted.before) == wanted.pair
    assert atlas.way_from(wanted.before) == (["vote no"], wanted.pair)
    assert atlas.unseen_in(wanted.before, {wanted.pair}) is None
    assert atlas.way_from(wanted.before, {wanted.pair}) is None


class Late(Subject):
    """An agent that does all as it should, on a machine that is always late but when it is alone."""

    def __init__(self, variant: Variant, alone: bool) -> None:
        super().__init__(variant)
        self._alone = alone
        self._now = 0.0

    async def _step(self, given: Input) -> Seen | None:
        before = state_of(self.model)
        advanced = advance(self.model, given, self._now)
        if advanced is None:
            return None
        outcome, self._now = advanced
        wrong = () if self._alone else ("it did not send what it should",)
        return Seen(pair_of(before, given), outcome, given.name, (), (), wrong, before, late=not self._alone)

    @property
    def hurried(self) -> bool:
        return False

    def exchanges(self) -> tuple[Exchange, ...]:
        return ()

    async def close(self) -> None:
        """Nothing is open."""


def test_what_a_late_machine_kept_from_being_seen_is_tried_alone_at_the_end() -> None:
    variant = VARIANTS["default"]
    steps = list(explore(variant))
    wanted = {step.pair: step for step in steps if step.before.doing == "idle" and not step.way}

    async def start(variant: Variant, alone: bool) -> Subject:
        return Late(variant, alone)

    for seconds, passed in ((60.0, len(wanted)), (-1.0, 0)):
        suite = Suite(start, [Vectors(variant, steps, wanted)], lambda count: None, side_by_side=3)
        asyncio.run(suite.run(time.monotonic() + seconds))
        assert [len(tally.passed) for tally in suite.tallies] == [passed]
        assert not suite.tallies[0].failures

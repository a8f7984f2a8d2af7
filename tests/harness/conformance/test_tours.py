"""Ways to the vectors that are yet to be seen."""

from harness.conformance.states import VARIANTS, explore
from harness.conformance.tours import Map


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

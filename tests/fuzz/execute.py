"""One input through one target, within bounds of time and memory; and many, mutated at random."""

import random
from collections.abc import Iterator, Sequence

from tests.fuzz.finding import bounded
from tests.fuzz.mutations import damaged
from tests.fuzz.targets import Target


def executed(target: Target, data: bytes) -> None:
    """Raises whatever the target does."""
    with bounded():
        target.run(data)


def mutated(inputs: Sequence[bytes], seed: int) -> Iterator[bytes]:
    """Damaged inputs without end; the same seed, the same damage."""
    chance = random.Random(seed)
    while True:
        yield damaged(chance.choice(inputs), chance)

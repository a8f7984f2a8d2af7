"""Run a target with one input, within limits of time and memory, and create random inputs."""

import random
from collections.abc import Iterator, Sequence

from tests.fuzz.finding import bounded
from tests.fuzz.mutations import damaged
from tests.fuzz.targets import Target


def executed(target: Target, data: bytes) -> None:
    """Run the target with the input. Raises FailedError if the run exceeds a limit. An exception of the target is
    raised, too.
    """
    with bounded():
        target.run(data)


def mutated(inputs: Sequence[bytes], seed: int) -> Iterator[bytes]:
    """Yield damaged copies of the inputs, without end. The same seed always gives the same copies."""
    chance = random.Random(seed)
    while True:
        yield damaged(chance.choice(inputs), chance)

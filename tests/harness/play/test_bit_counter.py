"""Test how a shared radio channel counts the losses of each receiver."""

from collections import Counter
from random import Random

from harness.play._shared_channel import BitCounter
from netem.channel import numbers


def test_counts_equal_those_of_a_loop_over_all_bits() -> None:
    rng = Random(1)
    counter, expected = BitCounter(), Counter[int]()
    for _ in range(1000):
        receivers = rng.getrandbits(50) & rng.getrandbits(50)
        counter.add(receivers)
        expected.update(numbers(receivers))
    assert counter.counts() == expected


def test_receiver_without_a_loss_has_no_count() -> None:
    counter = BitCounter()
    counter.add(0)
    counter.add(0b101)
    assert counter.counts() == {0: 1, 2: 1}

"""Compare the window of accepted sequence numbers (RFC 6479) with a set of all accepted numbers."""

from random import Random

from ucp.secure._window import WINDOW, ReplayWindow


def test_sequence_number_is_accepted_once_and_only_within_the_window() -> None:
    for seed in range(20):
        draw, window, came, newest = Random(seed), ReplayWindow(), set[int](), -1
        at = 0
        for _ in range(3000):
            at = max(0, at + draw.choice((1, 1, 1, 2, -3, -70, 65, 700, -1000, 1025)))
            fresh = at not in came and at > newest - WINDOW
            assert window.is_fresh(at) == fresh
            if fresh:
                window.accept(at)
                came.add(at)
                newest = max(newest, at)


def test_jump_over_the_whole_ring_clears_the_window() -> None:
    window = ReplayWindow()
    for sequence in (0, 63, 64, 2**32 - 1):
        window.accept(sequence)
    assert not window.is_fresh(2**32 - 1)
    assert not window.is_fresh(64)
    assert all(window.is_fresh(2**32 - 1 - back) for back in range(1, WINDOW))

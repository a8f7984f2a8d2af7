"""Test ten classes of forged datagrams. `python -m benchmarks.forgeries` sends more datagrams of each class."""

import pytest

from benchmarks.forgeries import CLASSES, forge, nonces, replays


@pytest.mark.parametrize("name", CLASSES)
def test_forgeries_are_dropped_and_change_no_state(name: str) -> None:
    accepted, changed, _, why = forge(CLASSES[name], 200)
    assert (accepted, changed, why.total()) == (0, False, 200)


def test_replayed_datagrams_change_no_state() -> None:
    same, dropped, findings = replays(1, 0.0)
    assert same == 1
    assert dropped > 100
    assert not findings


def test_no_nonce_repeats_under_a_key_although_disks_are_lost() -> None:
    sealed, twice = nonces(range(2))
    assert sealed > 100
    assert twice == 0

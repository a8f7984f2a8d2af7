"""Forgeries of ten classes, a small share of what `python -m benchmarks.forgeries` makes of them."""

import pytest

from benchmarks.forgeries import CLASSES, forge, nonces, replays


@pytest.mark.parametrize("name", CLASSES)
def test_no_forgery_is_accepted_and_none_changes_anything(name: str) -> None:
    accepted, changed, _, why = forge(CLASSES[name], 200)
    assert (accepted, changed, why.total()) == (0, False, 200)


def test_what_is_replayed_later_changes_nothing() -> None:
    same, dropped, findings = replays(1, 0.0)
    assert same == 1
    assert dropped > 100
    assert not findings


def test_no_key_is_used_with_a_nonce_twice_though_disks_are_lost() -> None:
    sealed, twice = nonces(range(2))
    assert sealed > 100
    assert twice == 0

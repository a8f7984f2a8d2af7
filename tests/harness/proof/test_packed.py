"""Test that states and successors are unchanged after they are stored in compact form and read again."""

import pytest

from harness.proof.graph._expansion import StateStore, SuccessorStore
from harness.proof.model._known_states import DEAD


def test_packed_state_has_one_number_and_unpacks_unchanged() -> None:
    wide = (9, 2**31 - 1, 70_000, DEAD, 300)
    states = StateStore(agents=2)
    assert [states.add(state) for state in ((0, 0, 0, 1, 2), wide, (0, 0, 0, 2, 1), wide)] == [0, 1, 2, 1]
    assert len(states) == 3
    assert states[1] == wide
    assert states[1:] == [wide, (0, 0, 0, 2, 1)]
    assert [*states] == [(0, 0, 0, 1, 2), wide, (0, 0, 0, 2, 1)]


def test_followers_keep_successors_by_timer() -> None:
    whole = [(), ((7,), (), (1, 2, 3)), ((),), ((2_000_000_000,),)]
    followers = SuccessorStore()
    for by_timer in whole:
        followers.append(by_timer)
    assert [*followers] == whole == followers[:]
    assert followers[2] == ((),)
    with pytest.raises(IndexError):
        followers[4]

"""Test the timer: it expires once, and can be paused and resumed (Section 3.2)."""

from tests.ucp.air import Air
from ucp.timers import Timer
from ucp.trigger import TimerTrigger


def test_paused_timer_keeps_its_remaining_time() -> None:
    timer = Timer("test")
    assert not timer.active
    timer.start(10.0, 5.0)
    assert timer.deadline == 15.0
    timer.pause(12.0)
    assert timer.active
    assert timer.deadline is None
    timer.resume(100.0)
    assert timer.deadline == 103.0
    timer.stop()
    assert not timer.active
    timer.resume(200.0)
    assert not timer.active


def test_expired_timers_are_handled_in_order_of_their_deadlines() -> None:
    """A late agent handles the expiry of a vote before the later expiry of a phase. It handles each of them once."""
    air = Air([1, 2], fate=lambda *_: [])
    air.fill_block(1)
    agent = air.agents[1]
    agent.begin_reconcile(7.0)  # phase one ends at 12, the vote at 10
    agent.handle_timer(60.0)
    agent.handle_timer(60.0)
    air.flush(1)
    timers = [run.trigger.timer for run in air.runs[1] if isinstance(run.trigger, TimerTrigger)]
    assert timers == ["voting", "phase one"]

"""Test loggable events and Algorithm 21."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ucp.events import EVENT_DATA_BYTES, LoggableEvent, MalformedEventsError, RandomEvents, decode_events

loggable_events = st.builds(LoggableEvent, st.integers(0, 2**64 - 1), st.integers(1, 254), st.binary(max_size=256))


@given(st.lists(loggable_events, max_size=8))
def test_encoded_events_decode_to_the_same_events(events: list[LoggableEvent]) -> None:
    assert decode_events(b"".join(event.encode() for event in events)) == events


@given(st.binary(max_size=300))
def test_random_event_data_decodes_or_raises_malformed(data: bytes) -> None:
    try:
        events = decode_events(data)
    except MalformedEventsError:
        return
    assert b"".join(event.encode() for event in events) == data


@pytest.mark.parametrize("event_id", [0, 255, -1])
def test_event_ids_are_1_to_254(event_id: int) -> None:
    with pytest.raises(ValueError, match=r"1\.\.254"):
        LoggableEvent(0, event_id, b"")


def test_random_events_have_the_interval_and_sizes_of_the_thesis() -> None:
    source = RandomEvents(Random(1))
    events = [source.next() for _ in range(3000)]
    times = [at_s for at_s, _, _ in events]
    trials = {round(at_s - times[0], 6) for at_s in times}
    assert times == sorted(times)
    assert times[0] % 1 != 0
    assert all(trial == round(trial) for trial in trials)
    assert times[-1] == pytest.approx(3000 * 30, rel=0.1)
    assert {len(data) for _, _, data in events} == set(EVENT_DATA_BYTES)
    assert {event_id for _, event_id, _ in events} == set(range(1, 255))

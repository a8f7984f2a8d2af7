"""Create random messages whose blocks contain valid events, and damaged datagrams."""

from hypothesis import strategies as st

from tests.ucp.test_events import loggable_events
from tests.ucp.test_messages import hashes, messages, senders, sequences, times
from ucp.block import MAX_EVENT_DATA_BYTES, Block
from ucp.messages import BlockResponse, CommitBlock, Message, encode

event_runs = (
    st.lists(loggable_events, min_size=1, max_size=8)
    .map(lambda events: b"".join(event.encode() for event in events))
    .filter(lambda run: len(run) <= MAX_EVENT_DATA_BYTES)
)
logged_blocks = st.builds(Block, senders, times, event_runs)
all_messages: st.SearchStrategy[Message] = st.one_of(
    messages, st.builds(CommitBlock, logged_blocks, hashes), st.builds(BlockResponse, logged_blocks)
)
datagrams = st.builds(encode, senders, sequences, all_messages)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """Draw a datagram that is damaged. It has changed bytes (mostly near its beginning), a missing end, or additional
    bytes.
    """
    datagram = bytearray(draw(datagrams))
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, 16) | st.integers(0, len(datagram) - 1))
        datagram[place] = draw(st.integers(0, 12) | st.integers(0, 255))
    cut = draw(st.none() | st.integers(1, len(datagram)))
    return bytes(datagram[:cut]) + draw(st.just(b"") | st.binary(max_size=100))

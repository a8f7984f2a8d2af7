"""Test the encoding of messages: each encoded message can be decoded, and other bytes are rejected."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ucp.block import Block
from ucp.messages import (
    HEADER,
    MAX_DATAGRAM_BYTES,
    TYPE_CODES,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    decode,
    encode,
)

hashes = st.binary(min_size=32, max_size=32)
times = st.integers(0, 2**64 - 1)
blocks = st.builds(Block, st.integers(1, 65535), times, st.binary(min_size=1, max_size=1024))
messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(BlockAddRequest, hashes, hashes),
    st.builds(BlockAddResponse, hashes, st.booleans(), st.none() | hashes),
    st.builds(CommitBlock, blocks, hashes),
    st.builds(ChainContainQuery, hashes),
    st.builds(ChainContainResponse, hashes, st.booleans()),
    st.builds(ChainHashSuccessorQuery, hashes),
    st.builds(NextInSequenceResponse, hashes, st.none() | hashes, times),
    st.builds(RequestForBlock, hashes),
    st.builds(BlockResponse, blocks),
)
senders = st.integers(1, 65535)
sequences = st.integers(0, 2**32 - 1)


@given(senders, sequences, messages)
def test_encoded_message_decodes_and_fits_one_datagram(sender: int, sequence: int, message: Message) -> None:
    datagram = encode(sender, sequence, message)
    assert len(datagram) <= MAX_DATAGRAM_BYTES
    assert decode(datagram) == (sender, sequence, message)


def test_largest_block_fits_a_datagram_without_fragmentation() -> None:
    datagram = encode(65535, 0, CommitBlock(Block(65535, 2**64 - 1, bytes(1024)), bytes(32)))
    assert len(datagram) == HEADER.size + 32 + 12 + 1024 <= 1500 - 28


@given(messages, st.data())
def test_truncated_or_padded_datagram_is_malformed(message: Message, data: st.DataObject) -> None:
    datagram = encode(1, 0, message)
    cut = data.draw(st.integers(0, len(datagram) - 1))
    for damaged in (datagram[:cut], datagram + b"\0", datagram + bytes(2000)):
        with pytest.raises(MalformedDatagramError):
            decode(damaged)


@pytest.mark.parametrize(
    ("offset", "value", "reason"),
    [(0, 0x00, "wrong magic"), (2, 2, "wrong version"), (3, 0, "unknown type"), (3, 10, "unknown type")],
)
def test_foreign_header_is_malformed(offset: int, value: int, reason: str) -> None:
    datagram = bytearray(encode(1, 0, RequestForBlock(bytes(32))))
    datagram[offset] = value
    with pytest.raises(MalformedDatagramError, match=reason):
        decode(bytes(datagram))


@pytest.mark.parametrize("sender", [0, 65536, 2**32 - 1])
def test_impossible_sender_is_malformed(sender: int) -> None:
    with pytest.raises(MalformedDatagramError, match="impossible sender"):
        decode(HEADER.pack(b"UC", 1, 8, sender, 0, 32) + bytes(32))


@given(st.binary(max_size=1600))
def test_random_bytes_raise_only_malformed_datagram(data: bytes) -> None:
    with pytest.raises(MalformedDatagramError):
        decode(data)


@given(st.sampled_from(sorted(TYPE_CODES.values())), st.binary(max_size=1100))
def test_random_body_decodes_or_raises_malformed_datagram(code: int, body: bytes) -> None:
    datagram = HEADER.pack(b"UC", 1, code, 1, 0, len(body)) + body
    try:
        sender, sequence, message = decode(datagram)
    except MalformedDatagramError:
        return
    assert encode(sender, sequence, message) == datagram

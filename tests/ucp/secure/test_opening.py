"""Test that scapy layers decrypt captured datagrams with a vehicle's keys, and cannot decrypt them without keys."""

from collections.abc import Iterator

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st
from scapy.config import conf
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether
from scapy.packet import Raw

from tests.ucp.datagrams import all_messages
from tests.ucp.secure.swarm import FULL, KEYS, agent, complete_a_block, session
from ucp.messages import BlockAddRequest, ChainContainQuery, CommitBlock, Message, encode
from ucp.scapy import UCP, Sealed, SecuredUCP, message_of, opened
from ucp.secure.bundle import KeySet
from ucp.secure.envelope import CLEAR, CLEAR_FIELDS, MalformedDatagramError, read_clear_header
from ucp.secure.opening import EPOCHS_AHEAD, DatagramOpener
from ucp.secure.revocation import Revocation
from ucp.secure.secured_agent import make_boot
from ucp.secure.session import Session


@pytest.fixture(autouse=True, scope="module")
def _scapy_raises_dissector_errors() -> Iterator[None]:
    conf.debug_dissector, before = True, conf.debug_dissector
    yield
    conf.debug_dissector = before


def sealed(message: Message, sequence: int = 7, by: Session | None = None) -> bytes:
    return (by or session(2)).seal(sequence, message, None, None, 0)


def opener(keys: KeySet = KEYS) -> DatagramOpener:
    return DatagramOpener(keys.bundle(1))


@given(all_messages)
def test_scapy_shows_the_clear_header_and_opens_the_body_with_a_bundle(message: Message) -> None:
    datagram = sealed(message)
    air = Ether(src="02:00:00:00:00:02", dst="ff:ff:ff:ff:ff:ff") / IP(src="10.77.0.2", dst="10.77.255.255")
    packet = Ether(bytes(air / UDP(sport=14600, dport=14600) / Raw(datagram)))
    header = packet[SecuredUCP]
    assert [header.getfieldval(name) for name in CLEAR_FIELDS] == list(CLEAR.unpack_from(datagram))
    assert type(header.payload) is Sealed
    assert bytes(header) == datagram
    plain = opened(packet, opener())
    assert message_of(plain) == (2, 7, message)
    assert bytes(plain) == encode(2, 7, message)


@given(st.data(), all_messages)
def test_opener_rejects_datagrams_of_other_keys_and_altered_datagrams(data: st.DataObject, message: Message) -> None:
    datagram = sealed(message)
    with pytest.raises(MalformedDatagramError, match="not authentic"):
        opener(KeySet.derived(bytes(31) + b"1", (1, 2, 3))).open(datagram)
    place = data.draw(st.integers(CLEAR.size, len(datagram) - 1))
    altered = datagram[:place] + bytes([datagram[place] ^ 1]) + datagram[place + 1 :]
    with pytest.raises(MalformedDatagramError, match=r"not authentic|not signed by its sender"):
        opener().open(altered)


def test_revoked_vehicle_still_reads_votes_and_unsealed_events() -> None:
    two, revoked = agent(2), DatagramOpener(KEYS.bundle(3))
    authority = Ed25519PrivateKey.from_private_bytes(KEYS.authority)
    two.revoke(Revocation.signed(authority, KEYS.public.mission, 1, [3]).encode(), 0.0)
    two.datagrams_to_send()
    (request,) = complete_a_block(two)
    assert type(revoked.open(request).datagram.message) is BlockAddRequest
    ends = two.next_timer()
    assert ends is not None
    two.handle_timer(ends)
    (commit,) = two.datagrams_to_send()
    message = revoked.open(commit).datagram.message
    assert type(message) is CommitBlock
    assert FULL in message.block.event_data


def test_opener_opens_later_epochs_and_rejects_earlier_and_far_ones() -> None:
    kept = [KEYS.bundle(2)]
    sender, reads = Session(kept[0], make_boot(1, bytes(8)), kept.append), opener()
    message = ChainContainQuery(bytes(32))
    datagrams = []
    for sequence, epoch in enumerate((0, 1, 5)):
        sender.set_clock(epoch * KEYS.public.epoch_s)
        datagrams.append(sealed(message, sequence, sender))
    for sequence, datagram in reversed(list(enumerate(datagrams))):  # in any order, and twice
        assert reads.open(datagram).datagram == reads.open(datagram).datagram == (2, sequence, message)
    assert kept[-1].epoch == 5
    with pytest.raises(MalformedDatagramError, match="epoch out of range"):
        DatagramOpener(kept[-1]).open(datagrams[0])
    far = read_clear_header(datagrams[0])._replace(epoch=EPOCHS_AHEAD + 1)
    with pytest.raises(MalformedDatagramError, match="epoch out of range"):
        reads.open(far.pack(len(datagrams[0]) - CLEAR.size) + datagrams[0][CLEAR.size :])


def test_revocation_is_shown_as_sealed_and_has_no_message() -> None:
    authority = Ed25519PrivateKey.from_private_bytes(KEYS.authority)
    body = Revocation.signed(authority, KEYS.public.mission, 3, [2, 9]).encode()
    packet = UCP(session(1).seal_revocation(body, 3))
    assert len(packet[Sealed].ciphertext) == len(body)
    with pytest.raises(MalformedDatagramError, match="no message"):
        opened(packet, opener())


@given(st.binary(max_size=200), st.integers(0, 10))
def test_scapy_shows_random_secured_datagrams_without_an_error(noise: bytes, code: int) -> None:
    datagram = b"UC\3" + bytes([code]) + noise
    assert bytes(UCP(datagram)) == datagram

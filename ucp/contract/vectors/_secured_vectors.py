"""Test vectors for secured missions: the datagram of each message, and datagrams that an agent must drop."""

from collections.abc import Iterator

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.block import Block
from ucp.contract.vectors._hash_vectors import BLOCKS
from ucp.contract.vectors._message_vectors import BLOCK_HASH, MESSAGES
from ucp.messages import CARRY_A_BLOCK, TYPE_CODES, BlockAddResponse, CommitBlock, Message, RequestForBlock, encode
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import KeySet
from ucp.secure.crypto_suite import expand
from ucp.secure.envelope import CLEAR, REQUEST_OF
from ucp.secure.revocation import Revocation, revocations_digest
from ucp.secure.sealed_datagrams import AnsweredRequest
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session

AGENT_ID, OTHER = 7, 28
ROSTER = tuple(sorted({AGENT_ID, *(sender for sender, _, _ in MESSAGES), *(block.agent_id for block in BLOCKS)}))
KEYS = KeySet.derived(bytes(range(32)), ROSTER)
OTHER_KEYS = KeySet.derived(bytes(32), ROSTER)
BOOT = make_boot(1_795_258_278_064_591, b"a chance")
EPOCH = 3
NOW = EPOCH * KEYS.public.epoch_s
NOW_US = 1_795_260_078_064_591


def session(agent_id: int, keys: KeySet = KEYS) -> Session:
    """Create the session of an agent at the time of the test vectors."""
    begun = Session(keys.bundle(agent_id), BOOT)
    begun.set_clock(0.0)
    begun.set_clock(NOW)
    return begun


def signature_of(block: Block) -> bytes:
    """Return the signature of a block by its author."""
    return sign_block(session(block.agent_id).private_key, KEYS.public.mission, block.block_data())


def cases() -> Iterator[tuple[str, bytes]]:
    """Yield each datagram with its description. Agent 7 receives the datagrams in this order."""
    other = session(OTHER)
    good = other.seal(1, RequestForBlock(BLOCK_HASH), None, None, 0)
    yield "a plain one", encode(OTHER, 1, RequestForBlock(BLOCK_HASH))
    yield "version 2", good[:2] + b"\2" + good[3:]
    yield "half a header", good[:20]
    yield "without its last byte", good[:-1]
    yield "type 13", good[:3] + b"\x0d" + good[4:]
    yield "its own", session(AGENT_ID).seal(0, RequestForBlock(BLOCK_HASH), None, None, 0)
    yield "of nobody on the roster", good[:4] + (5).to_bytes(4, "big") + good[8:]
    yield "of the epoch before the last", good[:14] + (EPOCH - 2).to_bytes(4, "big") + good[18:]
    yield "4097 epochs ahead", good[:14] + (EPOCH + 4097).to_bytes(4, "big") + good[18:]
    yield "with another revocation's number", good[:35] + b"\1" + good[36:]
    yield "of another mission", session(OTHER, OTHER_KEYS).seal(1, RequestForBlock(BLOCK_HASH), None, None, 0)
    yield "with another tag", good[:-1] + bytes([good[-1] ^ 1])
    imposter = session(1)
    imposter.agent_id = OTHER
    yield "signed by another sender", imposter.seal(9, RequestForBlock(BLOCK_HASH), None, None, 0)
    yield "a good one", good
    yield "the same again", good
    yield "of an earlier life", good[: CLEAR.size - 18] + bytes(16) + good[CLEAR.size - 2 :]
    stale = AnsweredRequest(AGENT_ID, BOOT, 99)
    yield "an answer to what was not asked", other.seal(2, BlockAddResponse(BLOCK_HASH, True), stale, None, 0)
    forged = CommitBlock(Block(1, 5, b"never made"), BLOCK_HASH)
    yield "a block that its maker did not sign", other.seal(3, forged, None, bytes(64), 0)
    yield "type 10, without the signature of the authority", other.seal_revocation(b"\0\1" * 2 + bytes(68), 1)
    yield "type 10, not sealed", other.seal_revocation(bytes(72), 1)[: CLEAR.size] + bytes(88)
    authority = Ed25519PrivateKey.from_private_bytes(KEYS.authority)
    revocation = Revocation.signed(authority, KEYS.public.mission, 2, [1, OTHER]).encode()
    yield "a revocation", other.seal_revocation(revocation, revocations_digest([1, OTHER]))
    earlier = Revocation.signed(authority, KEYS.public.mission, 1, [1]).encode()
    yield "a revocation of revoked agents only", other.seal_revocation(earlier, revocations_digest([1]))
    yield "of a revoked sender", other.seal(4, RequestForBlock(BLOCK_HASH), None, None, 0)


def vectors() -> dict[str, object]:
    """Return the test vectors. Keys are in hexadecimal, and datagrams are in base64."""
    receiver = SecuredAgent(session(AGENT_ID), AGENT_ID, ROSTER, b"test", tracing=True)
    dropped = []
    for what, datagram in cases():
        receiver.receive_datagram(datagram, NOW)
        (entry,) = receiver.trace()
        dropped.append({"what": what, "datagram": datagram, "dropped": getattr(entry, "dropped", None)})
    return {
        "epoch": EPOCH,
        "boot": BOOT.hex(),
        "group_secrets": {str(epoch): _secret(epoch).hex() for epoch in range(EPOCH + 1)},
        "bundles": {str(agent_id): KEYS.bundle(agent_id).to_json() for agent_id in ROSTER},
        "messages": [_sealed(*said) for said in MESSAGES],
        "export": receiver.signed_export(NOW_US),
        "drops": {"agent_id": AGENT_ID, "roster": ROSTER, "now": NOW, "datagrams": dropped},
    }


def _secret(epoch: int) -> bytes:
    secret = KEYS.group_secret
    for _ in range(epoch):
        secret = expand(secret, b"UCP epoch\0" + KEYS.public.mission, 32)
    return secret


def _sealed(sender: int, sequence: int, message: Message) -> dict[str, object]:
    request = AnsweredRequest(AGENT_ID, BOOT, 4) if TYPE_CODES[type(message)] in REQUEST_OF else None
    signature = signature_of(message.block) if type(message) in CARRY_A_BLOCK else None  # type: ignore[union-attr]
    sealed = session(sender).seal(sequence, message, request, signature, 0)
    named = None if request is None else {**request._asdict(), "boot": BOOT.hex()}
    plain = encode(sender, sequence, message)
    return {"plain": plain, "request": named, "block_signature": signature, "datagram": sealed}

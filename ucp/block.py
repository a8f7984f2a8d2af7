"""Define blocks and their hashes (Section 3.4, eq. 3.1-3.5).

A block does not contain its chain hash (eq. 3.2), because the chain hash depends on the blocks below it in a chain
(`ucp.chain`). A block therefore does not change if an agent pops it and commits it again.
"""

from functools import lru_cache

from ucp._dataclass import dataclass, field
from ucp.wire import FieldKind, struct_of

try:  # hashlib loads OpenSSL, which needs a quarter of an agent's memory
    from _sha2 import sha256  # type: ignore[import-not-found]
except ImportError:
    try:
        from _sha256 import sha256  # type: ignore[import-not-found]
    except ImportError:
        from hashlib import sha256

HASH_BYTES = 32
MAX_EVENT_DATA_BYTES = 1024
MAX_AGENT_ID = 0xFFFF
LATEST_US = 2**64 - 1
"""Latest timestamp in microseconds."""

CHAIN_HASHES_KEPT = 4096
"""Maximum number of chain hashes in the cache. The cache saves time, because the agents of one process and the checker
compute the same chain hashes.
"""

BLOCK_FIELDS = {"agent_id": FieldKind.U32, "timestamp_us": FieldKind.U64}
"""The header of a block."""
BLOCK_HEADER = struct_of(BLOCK_FIELDS)


def hash_digest(data: bytes) -> bytes:
    """Return the SHA-256 of the data (32 bytes). SHA-256 is the protocol's hash function H."""
    digest: bytes = sha256(data).digest()
    return digest


@lru_cache(CHAIN_HASHES_KEPT)
def next_chain_hash(chain_hash: bytes, block_hash: bytes) -> bytes:
    """Return the chain hash after one more block: CH_n = H(CH_{n-1} || BH_n) over the raw digests (eq. 3.2)."""
    return hash_digest(chain_hash + block_hash)


@dataclass(frozen=True, slots=True)
class Block:
    """A completed block (Section 3.4).

    `agent_id` is the agent that completed the block. `timestamp_us` is the time of its newest event in microseconds
    (Section 4.2). `event_data` holds its encoded events. `block_hash`, 32 bytes, is computed (eq. 3.1 over eq. 3.5).
    """

    agent_id: int
    timestamp_us: int
    event_data: bytes = field(repr=False)
    block_hash: bytes = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "block_hash", hash_digest(self.block_data()))

    def block_data(self) -> bytes:
        """Return BD_n (eq. 3.5), the encoding of the block in messages."""
        return BLOCK_HEADER.pack(self.agent_id, self.timestamp_us) + self.event_data


@dataclass(frozen=True, slots=True)
class InceptionBlock:
    """The inception block, block 0. It is the same on every agent before the mission begins (Section 3.4.1)."""

    block_data: bytes
    block_hash: bytes = field(init=False, compare=False)
    chain_hash: bytes = field(init=False, compare=False)

    def __post_init__(self) -> None:
        block_hash = hash_digest(self.block_data)
        object.__setattr__(self, "block_hash", block_hash)  # eq. 3.3
        object.__setattr__(self, "chain_hash", hash_digest(block_hash))  # eq. 3.4

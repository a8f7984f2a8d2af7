"""The signed head of a chain export, which protects the whole export against changes.

Signatures of blocks cover neither the order nor the number of blocks. The head covers both, and all other content of
the export. A reader of the export computes the values of the head again, and verifies the vehicle's signature of the
head. An attacker without the vehicle's private key can therefore alter nothing in its export.

`boot` and `number` order the exports of a vehicle, even if its clock was set back.
"""

import base64
import hashlib
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ucp.secure.crypto_suite import UnverifiedSignature
from ucp.secure.sealed_datagrams import Signer
from ucp.state import AgentState

_TAG = b"UCP export\0"
_FIELDS = struct.Struct(">I16sIQI32s32s32sH")


@dataclass(frozen=True)
class ExportHead:
    """The values that a vehicle signs. `completed` and `held` are digests. `revoked` lists ascending agent IDs."""

    agent_id: int
    boot: bytes
    number: int
    """The number of the export in this incarnation, from 1."""
    exported_at_us: int
    height: int
    """The number of blocks in the chain, without the inception block."""
    top_chain_hash: bytes
    completed: bytes
    held: bytes
    revoked: Sequence[int]

    def sign(self, signer: Signer, mission: bytes) -> dict[str, object]:
        """Sign the head, and return it as the JSON object that the export contains."""
        return {
            "mission": mission.hex(),
            "boot": self.boot.hex(),
            "number": self.number,
            "height": self.height,
            "top_chain_hash": self.top_chain_hash.hex(),
            "completed": self.completed.hex(),
            "held": self.held.hex(),
            "revoked": list(self.revoked),
            "signature": base64.b64encode(signer.sign(self._signed_bytes(mission))).decode("ascii"),
        }

    def claim(self, public_key: bytes, mission: bytes, signature: bytes) -> UnverifiedSignature:
        """Return the unverified claim that the owner of this public key signed the head in this mission."""
        return UnverifiedSignature(public_key, signature, self._signed_bytes(mission))

    def _signed_bytes(self, mission: bytes) -> bytes:
        fields = _FIELDS.pack(
            self.agent_id,
            self.boot,
            self.number,
            self.exported_at_us,
            self.height,
            self.top_chain_hash,
            self.completed,
            self.held,
            len(self.revoked),
        )
        return _TAG + mission + fields + struct.pack(f">{len(self.revoked)}I", *self.revoked)


def head_of(state: AgentState, boot: bytes, number: int, exported_at_us: int, revoked: Iterable[int]) -> ExportHead:
    """Return the head of an agent's export."""
    return ExportHead(
        state.agent_id,
        boot,
        number,
        exported_at_us,
        len(state.chain),
        state.chain.top_chain_hash,
        completed_digest(state.completed),
        held_digest(
            [block.block_hash for block in state.blocks_to_be_committed],
            [block.block_hash for block in state.reconcile_stack],
            bytes(state.current_block),
            reconciling=state.reconcile_in_progress,
            idle=state.idle,
        ),
        sorted(revoked),
    )


def completed_digest(block_hashes: Iterable[bytes]) -> bytes:
    """Return the digest of the list `completed`."""
    return hashlib.sha256(b"".join(block_hashes)).digest()


def held_digest(
    deque: Sequence[bytes], stack: Sequence[bytes], event_data: bytes, *, reconciling: bool, idle: bool
) -> bytes:
    """Return a digest of the agent's state outside its chain: deque, reconcile stack, current block and flags.

    `deque` and `stack` are block hashes in the order of the export. `event_data` is the content of the current block.
    """
    counts = struct.pack(">II??", len(deque), len(stack), reconciling, idle)
    return hashlib.sha256(counts + b"".join((*deque, *stack)) + event_data).digest()

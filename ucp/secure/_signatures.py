"""Keep the signatures of the blocks that an agent holds. Each block is signed by the agent that completed it. The
signatures are not part of the protocol state.
"""

from collections.abc import Mapping

from ucp.block import Block
from ucp.secure.block_signature import block_claim, sign_block
from ucp.secure.session import Session
from ucp.state import AgentState


class BlockSignatures:
    """The signatures that accompany blocks. Each block is signed by the agent that completed the block, and its
    signature is verified once. The signature of a received block that the agent did not accept is discarded.
    """

    def __init__(self, session: Session, state: AgentState) -> None:
        self._session = session
        self._state = state
        self._by_hash: dict[bytes, bytes] = {}
        self._signed = 0
        """Number of completed blocks (`state.completed`) at the last call of `held`. Only later blocks still need a
        signature.
        """

    def held(self) -> Mapping[bytes, bytes]:
        """Sign the agent's own new blocks. Then return the signatures of all blocks that the agent holds."""
        completed = self._state.completed
        if self._signed < len(completed):
            new = set(completed[self._signed :])
            for block in (*self._state.blocks_to_be_committed, *self._state.chain, *self._state.reconcile_stack):
                if block.block_hash in new and block.block_hash not in self._by_hash:
                    self._by_hash[block.block_hash] = self._sign(block)
            self._signed = len(completed)
        return self._by_hash

    def is_genuine(self, block: Block, signature: bytes) -> bool:
        """Return whether the agent that the block names has signed the block. If the signature is valid, keep it. The
        agent must be on the roster.
        """
        if block.block_hash in self.held():
            return True
        session = self._session
        claim = block_claim(session.public_keys[block.agent_id], session.mission, block.block_data(), signature)
        if not session.crypto.verify(claim):
            return False
        self._by_hash[block.block_hash] = signature
        return True

    def forget_unless_held(self, block: Block) -> None:
        """Discard the signature of a received block if the agent does not hold the block."""
        if not self._state.holds(block.block_hash):
            self._by_hash.pop(block.block_hash, None)

    def restore(self, signatures: Mapping[bytes, bytes]) -> None:
        """Add signatures that were read from the disk."""
        self._by_hash.update(signatures)

    def _sign(self, block: Block) -> bytes:
        return sign_block(self._session.private_key, self._session.mission, block.block_data())

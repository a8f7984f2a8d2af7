"""The makers' signatures of the blocks that an agent holds: beside the protocol, which knows nothing of them."""

from collections.abc import Mapping

from ucp.block import Block
from ucp.secure.block_signature import claim_of_block, sign_block
from ucp.secure.session import Session
from ucp.state import AgentState


class BlockSignatures:
    """Signatures by block hash. Each is checked once; of blocks that the agent does not hold none is kept."""

    def __init__(self, session: Session, state: AgentState) -> None:
        self._session = session
        self._state = state
        self._by_hash: dict[bytes, bytes] = {}
        self._signed = 0
        """How many of the blocks that the agent completed are signed."""

    def held(self) -> Mapping[bytes, bytes]:
        """Of all blocks that the agent holds; its own it signs by now at the latest."""
        completed = self._state.completed
        if self._signed < len(completed):
            new = set(completed[self._signed :])
            for block in (*self._state.blocks_to_be_committed, *self._state.chain, *self._state.reconcile_stack):
                if block.block_hash in new and block.block_hash not in self._by_hash:
                    self._by_hash[block.block_hash] = self._sign(block)
            self._signed = len(completed)
        return self._by_hash

    def is_genuine(self, block: Block, signature: bytes) -> bool:
        """Whether its maker, who is of the mission, signed the block. If so, the signature is kept for now."""
        if block.block_hash in self.held():
            return True
        session = self._session
        claim = claim_of_block(session.public_keys[block.agent_id], session.mission, block.block_data(), signature)
        if not session.arithmetic.verified(claim):
            return False
        self._by_hash[block.block_hash] = signature
        return True

    def forget_unless_held(self, block: Block) -> None:
        """The agent has looked at the block: it took it, or it did not."""
        if not self._state.holds(block.block_hash):
            self._by_hash.pop(block.block_hash, None)

    def restore(self, signatures: Mapping[bytes, bytes]) -> None:
        """Go on with what was on disk."""
        self._by_hash.update(signatures)

    def _sign(self, block: Block) -> bytes:
        return sign_block(self._session.private_key, self._session.mission, block.block_data())

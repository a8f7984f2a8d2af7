"""What blocks, chains and messages are called: as in the thesis's figures, 2.1 is the first block of agent 2."""

from harness.conformance.reference_model import Model
from harness.report.stories.message_text import in_words
from harness.report.stories.story_names import INCEPTION
from ucp.block import next_chain_hash
from ucp.messages import MalformedDatagramError, Message, decode


class Names:
    """What the reference knows by now."""

    def __init__(self, model: Model) -> None:
        state = model.state
        blocks = [*model.blocks.values(), *state.chain, *state.blocks_to_be_committed, *state.reconcile_stack]
        self._blocks: dict[str, str] = {}
        count: dict[int, int] = {}
        for block in {block.block_hash: block for block in blocks}.values():
            count[block.agent_id] = count.get(block.agent_id, 0) + 1
            self._blocks[block.block_hash.hex()] = f"{block.agent_id}.{count[block.agent_id]}"
        chain_hash, text = state.chain.inception.chain_hash, ""
        self._chains = {chain_hash: INCEPTION}
        self._below: dict[bytes, str] = {}
        for block in (*state.chain, *reversed(state.reconcile_stack)):
            below, chain_hash = self._chains[chain_hash], next_chain_hash(chain_hash, block.block_hash)
            text = f"{text} {self.block(block.block_hash.hex())}".strip()
            self._chains[chain_hash], self._below[chain_hash] = text, below
        for waiting in blocks:
            chain_hash = next_chain_hash(state.chain.top_chain_hash, waiting.block_hash)
            top = self._chains[state.chain.top_chain_hash]
            name = self.block(waiting.block_hash.hex())
            self._chains.setdefault(chain_hash, name if top == INCEPTION else f"{top} {name}")
            self._below.setdefault(chain_hash, top)

    def block(self, block_hash: str) -> str:
        return self._blocks.get(block_hash, "an unknown block")

    def chain(self, chain_hash: bytes) -> str:
        return self._chains.get(chain_hash, "an unknown chain")

    def chain_below(self, chain_hash: bytes) -> str:
        return self._below.get(chain_hash, "an unknown chain")


def told(message: Message, names: Names) -> str:
    """ "Commit Block (1.1 on inception)"."""
    return in_words(message, names)


def told_datagram(data: bytes, names: Names) -> str:
    try:
        return told(decode(data).message, names)
    except MalformedDatagramError as error:
        return f"{len(data)} bytes that are no message ({error.reason}): {data[:24].hex()}"

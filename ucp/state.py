"""The protocol state of one agent. Its attributes have the names of the thesis.

Drivers, chain exports and stores may read the state. Only event handlers change it, through `ucp.core`.
"""

from collections import Counter, deque

from ucp.block import Block, InceptionBlock
from ucp.chain import Chain
from ucp.handler import LocalEvent
from ucp.settings import Settings
from ucp.timers import Timer


class AgentState:
    """The state of an agent: its blocks, queries and counters. `now` is the mission second of its last input."""

    def __init__(self, agent_id: int, initial_data: bytes, settings: Settings) -> None:
        self.agent_id = agent_id
        self.settings = settings
        self.now = 0.0

        self.chain = Chain(InceptionBlock(initial_data))
        self.current_block = bytearray()
        self.blocks_to_be_committed: deque[Block] = deque()
        self.completed: list[bytes] = []
        self.newest_block_timestamp_us = -1

        self.voting_timer = Timer("voting")
        self.candidate_block: Block | None = None
        self.top_chain_hash_at_initiation = b""
        self.vote_count = {"yes": 0, "no": 0}
        self.voters: set[int] = set()

        self.reconcile_in_progress = False
        self.reconcile_stack: list[Block] = []
        self.phase_one_timer = Timer("phase one")
        self.reconcile_vote_count = {"yes": 0, "no": 0}
        self.reconcile_responders: set[int] = set()
        self.phase_two_timer = Timer("phase two")
        self.reconcile_response_dictionary: dict[bytes, list[int]] = {}
        self.majority_response_block_hash: bytes | None = None
        self.phase_three_timer = Timer("phase three")
        self.finalize_timer = Timer("finalize gap")

        self.reconcile_timers = (
            self.phase_one_timer,
            self.phase_two_timer,
            self.phase_three_timer,
            self.finalize_timer,
        )
        self.timers = (self.voting_timer, *self.reconcile_timers)
        self.triggered: deque[tuple[LocalEvent, str]] = deque()
        """Local events that wait for their handlers, each with the name of the handler that triggered it."""

        self.reconciles = 0
        self.chain_changed_at = 0.0
        self.sent: Counter[str] = Counter()
        self._held_aside: set[bytes] = set()  # hashes of the blocks in the deque and on the reconcile stack

    def holds(self, block_hash: bytes) -> bool:
        """Return true if the agent holds the block in its chain, deque or reconcile stack."""
        return block_hash in self.chain or block_hash in self._held_aside

    @property
    def idle(self) -> bool:
        """True if no timer runs, no reconcile is in progress, and no triggered handler waits to run."""
        if self.reconcile_in_progress:
            return False
        for timer in self.timers:
            if timer.deadline is not None:
                return False
        return not self.triggered

"""An agent core that can adopt the state that another agent recorded. A comparison can then continue after a deviation.

The judge gives the recorded inputs of an agent to a core of its own. After a deviation, the core and the agent are in
different states, and all later steps would differ too. `AdoptingCore` therefore replaces the core's state by the
agent's own state. It can extend any core that has the attributes of the reference's `ReferenceState`. Two cores use it:
the reference, which judges the agents, and the installed core, for a debugger and for `bisect`
(`harness.checker.steps.core_in_use`).
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from harness.checker.recorded_inputs import BlockIndex, NotOnRecordError, decoded
from harness.checker.reference.state import ReferenceState, Timer
from ucp.block import HASH_BYTES, Block
from ucp.messages import (
    BlockAddRequest,
    ChainContainQuery,
    ChainHashSuccessorQuery,
    MalformedDatagramError,
    Message,
    RequestForBlock,
    block_named,
)
from ucp.sealed import SEAL_BYTES, sealed_to
from ucp.trace import HandlerRun, SentMessage


class StateBeforeStep(NamedTuple):
    """Parts of the state before a step. They must be saved, because the recorded changes of the step are not sufficient
    to compute them afterwards.
    """

    stack: list[Block]
    current_block: bytes | None
    """The block under construction before a step that logs an event. None for any other step."""
    phase_three_ends: float | None


if TYPE_CHECKING:
    _Core = ReferenceState
else:
    _Core = object


class AdoptingCore(_Core):
    """An agent core that can undo its last step (`undo`), and instead take over the step that another agent recorded
    (`adopt`).
    """

    def __init__(self, agent_id: int, initial_data: bytes, settings: Any) -> None:
        super().__init__(agent_id, initial_data, settings)
        self.recorded_seal: bytes | None = None
        """The encrypted event data that the agent recorded for this step. The core lacks the agent's keys, so it cannot
        encrypt event data itself.
        """
        self._seals = sealed_to(initial_data) is not None
        self._moved: dict[str, Block] = {}
        """Block hash -> block, for all blocks that the core has held so far."""

    def event_data(self, timestamp_us: int) -> bytes:
        """Return the event data of the completed block. If the mission encrypts event data, return the encrypted data
        that the agent recorded.
        """
        events = bytes(self.current_block)
        sealed = self.recorded_seal
        return sealed if self._seals and sealed and len(sealed) == len(events) + SEAL_BYTES else events

    def changed(self, operation: str, block: Block) -> None:
        block_hash = block.block_hash.hex()
        self._moved[block_hash] = block
        self.changes.append((operation, block_hash))

    def unchanging(self) -> Iterator[object]:
        """Yield the objects that never change, so that copies of the core can share them."""
        yield from (self.settings, self.chain.inception, self._moved, *self._moved.values())
        yield from (message for _, message in self.outbox)

    def be_idle_with(self, chain: Iterable[Block], current_block: bytes, sequence: int) -> None:
        """Put the core into the state of an idle agent that holds only the blocks of this chain."""
        for block in chain:
            self.commit(block)
            if block.agent_id == self.agent_id:
                self.newest_block_timestamp_us = max(self.newest_block_timestamp_us, block.timestamp_us)
        self.current_block += current_block
        self.sequence = sequence
        self.step_is_over()

    def before(self, run: HandlerRun) -> StateBeforeStep | None:
        """Return the data that `undo` needs in addition to the recorded changes of the step. Return None if `undo`
        needs only the recorded changes.
        """
        logs, phase_three_ends = run.handler == "build_data_block", self.phase_three_timer.deadline
        if not (logs or self.reconcile_stack or phase_three_ends is not None):
            return None
        return StateBeforeStep(
            list(self.reconcile_stack), bytes(self.current_block) if logs else None, phase_three_ends
        )

    def step_is_over(self) -> None:
        """Forget the changes, messages and timers of the last step."""
        if self.changes:
            self.changes = []
        if self.outbox:
            self.outbox = []
        if self.started:
            self.started = {}

    def has_sent(self, sent: Sequence[SentMessage]) -> bool:
        """Return true if the last step sent exactly these messages."""
        if len(sent) != len(self.outbox):
            return False
        for number, recorded in enumerate(sent):
            sequence, message = self.outbox[number]
            try:
                datagram = decoded(recorded.datagram)
            except MalformedDatagramError:  # after a mistake, the core can hold a block that is too large
                if recorded != SentMessage.of(self.agent_id, sequence, message):
                    return False
                continue
            if datagram.message != message or datagram.sequence != sequence or datagram.sender != self.agent_id:
                return False
            about = block_named(message)
            if (
                recorded.message != message.NAME
                or recorded.seq != sequence
                or recorded.block != (about.hex() if about else None)
            ):
                return False
        return True

    def sent_in_full(self) -> list[SentMessage]:
        """Return the messages of the last step in the format of a trace line."""
        return [SentMessage.of(self.agent_id, sequence, message) for sequence, message in self.outbox]

    def go_along(self, run: HandlerRun) -> None:
        """Before phase 3 of the reconcile, select the block that the agent selected. After an earlier deviation, this
        core may have selected a different block, or none.
        """
        if run.handler == "reconcile_phase_3":
            hashes = [block_hash for operation, block_hash in run.changes if operation == "chain+"]
            hashes += [sent.block for sent in run.sent if sent.block is not None]
            if hashes and len(hashes[0]) == 2 * HASH_BYTES:
                self.majority_response_block_hash = bytes.fromhex(hashes[0])

    def undo(self, before: StateBeforeStep | None) -> None:
        """Undo the changes that the last step made to blocks and timers. The votes are not restored, because `adopt`
        replaces them.

        The argument `before` is the result of the method `before`. It is None if the recorded changes are sufficient to
        undo the step.
        """
        for operation, block_hash in reversed(self.changes):
            match operation:
                case "complete":
                    self.completed.pop()
                case "chain+":
                    self.chain.pop()
                case "chain-":
                    self.chain.append(self._moved[block_hash])
                case "deque+":
                    self.blocks_to_be_committed.pop()
                case "deque-":
                    self.blocks_to_be_committed.appendleft(self._moved[block_hash])
                case "stack+":
                    self.reconcile_stack.pop()
                case "stack-":
                    self.reconcile_stack.append(self._moved[block_hash])
        for timer in self.timers:
            if timer.name in self.started:
                timer.stop()
        if before is not None:
            self.reconcile_stack[:] = before.stack
            if before.current_block is not None:
                self.current_block[:] = before.current_block
            self.phase_three_timer.deadline = before.phase_three_ends
        self.sequence -= len(self.outbox)
        self.step_is_over()

    def adopt(self, run: HandlerRun, blocks: BlockIndex) -> None:
        """Set the state of this core to the state that the agent recorded after `run`. Raises NotOnRecordError if the
        records are insufficient.
        """
        for operation, block_hash in run.changes:
            self._adopt_change(operation, self._moved.get(block_hash) or blocks.get(block_hash))
        if run.handler == "build_data_block" and run.changes:
            self.current_block.clear()
        self.note_held()
        state = run.state
        held = len(self.chain), len(self.blocks_to_be_committed), len(self.reconcile_stack)
        if held != (state.chain, state.deque, state.stack):
            raise NotOnRecordError("its state differs from the result of its changes")
        self._adopt_top(state.top)
        self.reconcile_in_progress = state.reconciling
        self.triggered.clear()
        self._adopt_sent(run.sent)
        self._adopt_timers(run)
        self._adopt_tally(run)
        self.step_is_over()

    def _adopt_change(self, operation: str, block: Block) -> None:
        try:
            match operation:
                case "complete":
                    self.completed.append(block.block_hash)
                    self.newest_block_timestamp_us = block.timestamp_us
                case "chain+":
                    self.chain.append(block)
                case "chain-":
                    if self.chain.pop() != block:
                        raise NotOnRecordError("it removed a block from its chain that was not on top")
                case "deque+":
                    self.blocks_to_be_committed.append(block)
                case "deque-":
                    self.blocks_to_be_committed.remove(block)
                case "stack+":
                    self.reconcile_stack.append(block)
                case "stack-":
                    self.reconcile_stack.remove(block)
                case _:
                    raise NotOnRecordError(f"the change {operation[:20]!r} is unknown")
        except (ValueError, IndexError):
            raise NotOnRecordError(f"its change {operation} {block.block_hash.hex()[:12]} is impossible") from None

    def _adopt_top(self, top: str) -> None:
        if self.chain.top_chain_hash.hex() != top:
            try:
                chain_hash = bytes.fromhex(top)
            except ValueError:
                chain_hash = b""
            if len(chain_hash) != HASH_BYTES:
                raise NotOnRecordError("its top chain hash is not a hash")
            self.chain.top_chain_hash = chain_hash

    def _adopt_sent(self, sent: Iterable[SentMessage]) -> None:
        """Start the timers that belong to the sent messages. A vote, a query and a request each start the timer that
        limits the wait for answers.
        """
        for announced in sent:
            self.sequence = announced.seq + 1
            try:
                message = decoded(announced.datagram).message
            except MalformedDatagramError:
                continue
            if timer := self._asked(message):
                timer.start(self.now, self._duration(timer))

    def _asked(self, message: Message) -> Timer | None:
        """Prepare the core to count the answers to `message`. Return the timer that limits the wait for these answers.
        Return None if the message expects no answer.
        """
        match message:
            case BlockAddRequest():
                waiting = (*self.blocks_to_be_committed, *self.reconcile_stack, *self.chain)
                named = (block for block in waiting if block.block_hash == message.block_hash)
                self.candidate_block = next(named, None)
                self.top_chain_hash_at_initiation = self.chain.top_chain_hash
                self.vote_count = {"yes": 1, "no": 0}
                self.voters.clear()
                return self.voting_timer
            case ChainContainQuery():
                self.reconcile_vote_count = {"yes": 0, "no": 0}
                self.reconcile_responders.clear()
                return self.phase_one_timer
            case ChainHashSuccessorQuery():
                self.reconcile_response_dictionary.clear()
                self.reconcile_responders.clear()
                return self.phase_two_timer
            case RequestForBlock():
                self.majority_response_block_hash = message.block_hash
                return self.phase_three_timer
        return None

    def _duration(self, timer: Timer) -> float:
        return {
            "voting": self.settings.vote_timeout_s,
            "phase one": self.settings.phase1_timeout_s,
            "phase two": self.settings.phase2_timeout_s,
            "phase three": self.settings.phase3_timeout_s,
            "finalize gap": self.settings.finalize_gap_s,
        }[timer.name]

    def _adopt_timers(self, run: HandlerRun) -> None:
        for timer in self.timers:
            if (duration := (run.started or {}).get(timer.name)) is not None:
                timer.start(self.now, duration)
        if run.branch == "recommitted, more to come" and self.finalize_timer.name not in (run.started or ()):
            self.finalize_timer.start(self.now, self.settings.finalize_gap_s)
        if run.handler == "receive_response_block_for_hash" and run.changes:
            self.phase_three_timer.stop()
        only_in_a_reconcile = self.reconcile_timers[: -1 if self.settings.asks_after_commit else None]
        for timer in self.timers:
            if run.state.idle or (timer in only_in_a_reconcile and not run.state.reconciling):
                timer.stop()

    def _adopt_tally(self, run: HandlerRun) -> None:
        if run.tally is None:
            return
        votes = {key: count for key, count in run.tally.items() if key in ("yes", "no") and isinstance(count, int)}
        match run.algorithm:
            case 2 | 4 if len(votes) == 2:
                self.vote_count = votes
            case 8 | 10 if len(votes) == 2:
                self.reconcile_vote_count = votes
            case 15:
                self.majority_response_block_hash = next(map(_as_hash, run.tally), None)
            case 12 | 14:
                self.reconcile_response_dictionary = {
                    _as_hash(candidate): [int(number) for number in counted]
                    for candidate, counted in run.tally.items()
                    if isinstance(counted, list) and len(counted) == 2
                }


def _as_hash(text: str) -> bytes:
    """Return the hash as bytes. Raises NotOnRecordError if the text is not a hash."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise NotOnRecordError("its candidates are not block hashes") from None

"""Deliberate errors in reconciling (Algorithms 7 to 20)."""

from dataclasses import replace

from ucp.block import Block
from ucp.core import Core
from ucp.handler import LocalEvent
from ucp.messages import (
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
)
from ucp.quirks._commit_quirks import run_as_if_not_reconciling
from ucp.quirks._quirk import Handler, Helper, quirk
from ucp.reconcile import most_named
from ucp.timers import Timer


@quirk(7)
def never_reconcile(good: Handler, core: Core) -> str:
    """The agent never starts a reconcile."""
    return "already in progress"


@quirk(7)
def reconcile_unflagged(good: Handler, core: Core) -> str:
    """A reconcile does not set `reconcile_in_progress`. The agent still votes, sends answers and starts reconciles."""
    branch = good(core)
    core.reconcile_in_progress = False
    return branch


@quirk(8)
def keep_old_phase1_tally(good: Handler, core: Core) -> str:
    """Phase 1 does not reset its counters for a new query, so answers to the previous query still count."""
    before = core.reconcile_vote_count
    branch = good(core)
    core.reconcile_vote_count = before
    return branch


@quirk(8, helper=Core.start)
def hasty_phase1(good: Helper, core: Core, timer: Timer, duration_s: float) -> None:
    """The phase 1 timer expires after a thousandth of its duration."""
    good(core, timer, duration_s / 1000)


@quirk(9, helper=Core.send)
def contain_everything(good: Helper, core: Core, message: ChainContainResponse) -> None:
    """The agent answers each Chain Contain Query with yes."""
    good(core, replace(message, contained=True))


@quirk(9)
def answer_phase1_while_reconciling(good: Handler, core: Core, sender: int, message: ChainContainQuery) -> str:
    """The agent answers Chain Contain Queries while it reconciles."""
    return run_as_if_not_reconciling(good, core, sender, message)


@quirk(10)
def count_phase1_of_others(good: Handler, core: Core, sender: int, message: ChainContainResponse) -> str:
    """The agent counts phase 1 answers about other chains as answers about its own chain."""
    return good(core, sender, replace(message, chain_hash=core.chain.top_chain_hash))


@quirk(10)
def count_phase1_twice(good: Handler, core: Core, sender: int, message: ChainContainResponse) -> str:
    """If a phase 1 answer arrives twice, both copies count."""
    core.reconcile_responders.discard(sender)
    return good(core, sender, message)


@quirk(11)
def other_phase1_tie(good: Handler, core: Core) -> str:
    """The agent resolves a tie in phase 1 contrary to the setting `phase1_tie`."""
    if core.reconcile_vote_count["yes"] == core.reconcile_vote_count["no"] > 0:
        core.reconcile_vote_count["no" if core.settings.phase1_tie == "phase2" else "yes"] += 1
    return good(core)


@quirk(11)
def never_pop(good: Handler, core: Core) -> str:
    """Phase 1 continues with phase 2 regardless of the answers."""
    core.reconcile_vote_count["yes"] += core.reconcile_vote_count["no"]
    return good(core)


@quirk(11, helper=Core.pop_to_stack)
def pop_two_blocks(good: Helper, core: Core) -> None:
    """Phase 1 removes two blocks at a time from the chain."""
    good(core)
    if len(core.chain):
        good(core)


@quirk(11, helper=Core.pop_to_stack)
def lose_popped_block(good: Helper, core: Core) -> None:
    """Phase 1 removes a block from the chain and does not put it onto the reconcile stack."""
    good(core)
    core.pop_from_stack()


@quirk(11, helper=Core.trigger, triggers=("Reconcile Phase 3",))
def skip_phase2(good: Helper, core: Core, event: LocalEvent) -> None:
    """Phase 1 triggers phase 3 instead of phase 2."""
    good(core, "Reconcile Phase 3" if event == "Reconcile Phase 2" else event)


@quirk(12, helper=Core.send)
def never_ask_phase2(good: Helper, core: Core, message: ChainHashSuccessorQuery) -> None:
    """Phase 2 waits for answers but sends no query."""


@quirk(12)
def keep_old_candidates(good: Handler, core: Core) -> str:
    """Phase 2 does not reset its candidates for a new query, so answers to the previous query still count."""
    before = dict(core.reconcile_response_dictionary)
    branch = good(core)
    core.reconcile_response_dictionary.update(before)
    return branch


@quirk(13)
def name_successor_while_reconciling(good: Handler, core: Core, sender: int, message: ChainHashSuccessorQuery) -> str:
    """The agent answers Chain Hash Successor Queries while it reconciles."""
    return run_as_if_not_reconciling(good, core, sender, message)


@quirk(13, helper=Core.send)
def name_top_as_successor(good: Helper, core: Core, message: NextInSequenceResponse) -> None:
    """The agent names its top block as the successor of each block."""
    if message.block_hash is not None:
        *_, top = core.chain
        message = replace(message, block_hash=top.block_hash, timestamp_us=top.timestamp_us)
    good(core, message)


@quirk(13, helper=Core.trigger)
def diverged_and_unmoved(good: Helper, core: Core, event: LocalEvent) -> None:
    """The agent starts no reconcile when a query shows that its chain has diverged."""


@quirk(14)
def count_phase2_twice(good: Handler, core: Core, sender: int, message: NextInSequenceResponse) -> str:
    """If a phase 2 answer arrives twice, both copies count."""
    core.reconcile_responders.discard(sender)
    return good(core, sender, message)


@quirk(14)
def count_phase2_of_others(good: Handler, core: Core, sender: int, message: NextInSequenceResponse) -> str:
    """The agent counts phase 2 answers about other chains as answers about its own chain."""
    return good(core, sender, replace(message, chain_hash=core.chain.top_chain_hash))


@quirk(15)
def crash_on_tie(good: Handler, core: Core) -> str:
    """A tie in phase 2 raises an exception, and the reconcile never ends."""
    if len(most_named(core.reconcile_response_dictionary)) > 1:
        raise NameError
    return good(core)


@quirk(15)
def youngest_on_tie(good: Handler, core: Core) -> str:
    """The agent selects the answer with the youngest timestamp in a tie of phase 2."""
    for counter_record in core.reconcile_response_dictionary.values():
        counter_record[1] = -counter_record[1]
    return good(core)


@quirk(15)
def choose_minority(good: Handler, core: Core) -> str:
    """The agent selects the phase 2 answer that the fewest agents gave."""
    for counter_record in core.reconcile_response_dictionary.values():
        counter_record[0] = -counter_record[0]
    return good(core)


@quirk(16)
def early_phase3_expiry(good: Handler, core: Core) -> str:
    """The phase 3 timer expires when it starts, so each block arrives too late."""
    branch = good(core)
    if branch == "asked":
        core.start(core.phase_three_timer, 0.0)
    return branch


@quirk(16)
def ask_for_what_is_held(good: Handler, core: Core) -> str:
    """Phase 3 requests a block from other agents although it is on the reconcile stack."""
    if core.majority_response_block_hash not in [block.block_hash for block in core.reconcile_stack]:
        return good(core)
    core.start(core.phase_three_timer, core.settings.phase3_timeout_s)
    core.send(RequestForBlock(core.majority_response_block_hash))
    return "asked"


@quirk(16, helper=Core.commit)
def lose_block_from_stack(good: Helper, core: Core, block: Block) -> None:
    """A block that phase 3 takes from the reconcile stack is not added to the chain."""


@quirk(16, helper=Core.trigger)
def stop_after_stack(good: Helper, core: Core, event: LocalEvent) -> None:
    """Phase 3 stops after it takes a block from the reconcile stack, as in the printed pseudo-code."""


@quirk(17)
def send_blocks_while_reconciling(good: Handler, core: Core, sender: int, message: RequestForBlock) -> str:
    """The agent sends requested blocks while it reconciles."""
    return run_as_if_not_reconciling(good, core, sender, message)


@quirk(17, helper=Core.send)
def send_top_block(good: Helper, core: Core, message: BlockResponse) -> None:
    """The agent answers each Request for Block with its top block."""
    *_, top = core.chain
    good(core, BlockResponse(top))


@quirk(17, helper=Core.send, sends=(CommitBlock,))
def wrong_topic(good: Helper, core: Core, message: BlockResponse) -> None:
    """The agent sends a requested block as a Commit Block, and the receiver runs the wrong handler."""
    good(core, CommitBlock(message.block, core.chain.top_chain_hash))


@quirk(18)
def take_any_block(good: Handler, core: Core, sender: int, message: BlockResponse) -> str:
    """Phase 3 commits the first block that arrives, requested or not."""
    core.majority_response_block_hash = message.block.block_hash
    return good(core, sender, message)


@quirk(18)
def stale_chain_hash(good: Handler, core: Core, sender: int, message: BlockResponse) -> str:
    """Phase 3 commits a block and does not update the top chain hash."""
    chain_hash_before = core.chain.top_chain_hash
    branch = good(core, sender, message)
    core.chain.top_chain_hash = chain_hash_before
    return branch


@quirk(18)
def phase3_timer_runs_on(good: Handler, core: Core, sender: int, message: BlockResponse) -> str:
    """The phase 3 timer continues after the block has arrived."""
    timer = core.phase_three_timer
    deadline = timer.deadline
    branch = good(core, sender, message)
    timer.deadline = deadline
    return branch


@quirk(18)
def pause_without_resume(good: Handler, core: Core, sender: int, message: BlockResponse) -> str:
    """The phase 3 timer stays paused after a block that was not requested."""
    branch = good(core, sender, message)
    if branch == "another block":
        core.phase_three_timer.pause(core.now)
    return branch


@quirk(18, helper=Core.trigger, triggers=("Reconcile Phase 1",))
def wrong_event(good: Helper, core: Core, event: LocalEvent) -> None:
    """After phase 3 has committed a block, the agent continues with phase 1 instead of phase 2."""
    good(core, "Reconcile Phase 1")


@quirk(19, helper=Core.trigger, triggers=("Reconcile Phase 2",))
def never_give_up(good: Helper, core: Core, event: LocalEvent) -> None:
    """If no block arrives, the agent returns to phase 2 instead of continuing with Finalize."""
    good(core, "Reconcile Phase 2")


@quirk(19, helper=Core.trigger)
def give_up_unfinished(good: Helper, core: Core, event: LocalEvent) -> None:
    """If no block arrives, the agent stops the reconcile without the phase Finalize."""


@quirk(20)
def forget_stack(good: Handler, core: Core) -> str:
    """Finalize drops the remaining blocks of the reconcile stack."""
    while core.reconcile_stack:
        core.pop_from_stack()
    return good(core)


@quirk(20)
def stack_upside_down(good: Handler, core: Core) -> str:
    """Finalize commits the blocks of the reconcile stack from the bottom up."""
    if core.reconcile_stack:
        core.reconcile_stack.append(core.reconcile_stack.pop(0))
    return good(core)


@quirk(20, helper=Core.send)
def finalize_silently(good: Helper, core: Core, message: Message) -> None:
    """Finalize commits blocks and sends no Commit Block."""


@quirk(20)
def leave_flag_set(good: Handler, core: Core) -> str:
    """Finalize does not clear `reconcile_in_progress`."""
    branch = good(core)
    core.reconcile_in_progress = True
    return branch


@quirk(20, helper=Core.trigger)
def finalize_and_wait(good: Helper, core: Core, event: LocalEvent) -> None:
    """Finalize does not propose the next block of the deque."""

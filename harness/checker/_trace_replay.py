"""Replay a trace: apply the changes of each handler run, and compare the result with the state in the same trace line.

The module reads each trace once. It collects observations for all checks that need to know which blocks an agent held
at each step.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, pairwise

from harness.archive.history import LATEST_S
from harness.archive.traces import Trace
from harness.archive.vocabulary import OPERATIONS
from harness.checker.reference.algorithms import HANDLERS
from ucp.block import HASH_BYTES, next_chain_hash
from ucp.trace import HandlerRun, StateSummary

BEGINS_OR_ENDS_A_RECONCILE = frozenset(("reconcile_begin", "reconcile_finalize"))

COMPLETES = "build_data_block"


@dataclass(frozen=True, slots=True)
class TraceObservation:
    """A fact that the checker observed at one line of a trace. The first line has number 1."""

    line: int
    run: HandlerRun
    what: str
    block_hash: str | None = None

    @property
    def where(self) -> str:
        """The line, the time and the handler of the observation as text, such as "trace line 7, t=12.5 s,
        receive_commit_block".
        """
        return f"trace line {self.line}, t={self.run.t:g} s, {self.run.handler}"


@dataclass(slots=True)
class ReplayedIncarnation:
    """The replayed trace of one incarnation of an agent (the time between two restarts). It contains the hashes of the
    blocks that the agent held at the end, and all observations of errors.
    """

    trace: Trace
    number: int
    """Number of restarts of the agent before this incarnation. It is 0 for the first incarnation."""
    runs: list[HandlerRun]
    chain: list[str] = field(default_factory=list)
    """The chain. The oldest block is first."""
    deque: list[str] = field(default_factory=list)
    """The deque. The front block is first."""
    stack: list[str] = field(default_factory=list)
    """The reconcile stack. The top block is last."""
    completed: list[str] = field(default_factory=list)
    sent: int = 0
    unknown: bool = False
    """True if the trace contains unknown changes of blocks. After the first unknown change, the replay does not know
    which blocks the agent holds.
    """
    impossible: list[TraceObservation] = field(default_factory=list)
    """Changes in the trace that are impossible, such as the removal of a block that the agent does not hold."""
    second_copies: list[TraceObservation] = field(default_factory=list)
    idle_too_early: list[TraceObservation] = field(default_factory=list)
    """Trace lines on which the agent claimed to be idle although it was not. Blocks were in its deque or on its stack,
    or its chain lacked blocks that it had completed.
    """
    wrong_lengths: list[TraceObservation] = field(default_factory=list)
    """The first trace line on which the recorded number of blocks in chain, deque or stack differs from the number that
    follows from all changes so far. Empty if there is none.
    """
    wrong_tops: list[TraceObservation] = field(default_factory=list)
    """The first trace line on which the recorded top chain hash differs from the computed one (eq. 3.2). Empty if there
    is none.
    """
    flags: list[TraceObservation] = field(default_factory=list)
    """Trace lines with impossible flags: the agent is idle and reconciles at the same time, or a reconcile begins or
    ends in a handler that cannot begin or end it.
    """
    back_in_time: list[TraceObservation] = field(default_factory=list)
    out_of_sequence: list[TraceObservation] = field(default_factory=list)

    def numbered_runs(self) -> Iterator[tuple[int, HandlerRun]]:
        """Yield the handler runs together with their line numbers."""
        return next(islice(self.trace.incarnations(), self.number, None))


def replay(trace: Trace, inception: str | None) -> list[ReplayedIncarnation]:
    """Replay a trace. Return one result for each part of the trace between two restarts of the agent."""
    bounds = [0, *trace.starts, len(trace.runs)]
    return [
        _replay_incarnation(ReplayedIncarnation(trace, number, trace.runs[start:end]), inception)
        for number, (start, end) in enumerate(pairwise(bounds))
    ]


def _replay_incarnation(incarnation: ReplayedIncarnation, inception: str | None) -> ReplayedIncarnation:
    held = _HeldBlocks(incarnation, inception)
    checked: StateSummary | None = None
    reconciling, compared, now, sequence = False, True, 0.0, 0
    for line, run in incarnation.numbered_runs():
        state = run.state
        if run.changes and not incarnation.unknown:
            held.change(line, run)
            checked = None
            compared = compared and not incarnation.unknown
        if state is not checked:
            checked = state
            if compared:
                compared = held.compare(line, run)
            if state.reconciling != reconciling:
                reconciling = state.reconciling
                if run.handler in HANDLERS and run.handler not in BEGINS_OR_ENDS_A_RECONCILE:
                    what = (
                        f"a reconcile {'begins' if reconciling else 'ends'} in a handler other than Algorithms 7 and 20"
                    )
                    incarnation.flags.append(TraceObservation(line, run, what))
            if state.idle and reconciling:
                incarnation.flags.append(TraceObservation(line, run, "idle and reconciling at once"))
        if state.idle and held.has_blocks_aside and not incarnation.unknown:
            incarnation.idle_too_early.append(held.idle_too_early(line, run))
        if not now <= run.t <= LATEST_S:
            incarnation.back_in_time.append(
                TraceObservation(line, run, f"the time goes back from {now:g} s to {run.t:g} s")
            )
        now = run.t
        for message in run.sent:
            if message.seq != sequence:
                what = f"sent message number {message.seq}, but the next number is {sequence}"
                incarnation.out_of_sequence.append(TraceObservation(line, run, what))
                sequence = message.seq
            sequence += 1
            incarnation.sent += 1
    return incarnation


class _HeldBlocks:
    """The blocks that an agent holds at one moment of its trace. The replay updates them with each handler run."""

    def __init__(self, incarnation: ReplayedIncarnation, inception: str | None) -> None:
        self._incarnation = incarnation
        self._copies: dict[str, int] = {}
        self._places = {"chain": incarnation.chain, "deque": incarnation.deque, "stack": incarnation.stack}
        self._chain_hashes = [bytes.fromhex(inception)] if inception is not None else None
        """Chain hash of each block in the chain, starting with the inception block. None if the hash of the inception
        block is unknown.
        """
        self._completed: set[str] = set()
        self._not_in_chain: dict[str, None] = {}
        self.has_blocks_aside = False

    def change(self, line: int, run: HandlerRun) -> None:
        incarnation = self._incarnation
        if not OPERATIONS.issuperset(operation for operation, _ in run.changes):
            incarnation.unknown = True
            return
        for operation, block in run.changes:
            if operation == "complete":
                incarnation.completed.append(block)
                self._completed.add(block)
                self._not_in_chain[block] = None
                continue
            place = self._places[operation[:-1]]
            if operation[-1] == "-":
                if impossible := self._take(operation[:-1], place, block):
                    incarnation.impossible.append(TraceObservation(line, run, impossible, block))
            else:
                if run.handler == COMPLETES and block not in self._completed:
                    incarnation.impossible.append(
                        TraceObservation(line, run, "a block joins the deque before the agent completed it", block)
                    )
                self._put(operation[:-1], place, block)
                if self._copies[block] > 1:
                    incarnation.second_copies.append(TraceObservation(line, run, "", block))
        self.has_blocks_aside = bool(self._not_in_chain or incarnation.deque or incarnation.stack)

    def _put(self, name: str, place: list[str], block: str) -> None:
        place.append(block)
        self._copies[block] = self._copies.get(block, 0) + 1
        if name == "chain":
            self._not_in_chain.pop(block, None)
            if self._chain_hashes is not None:
                self._chain_hashes.append(next_chain_hash(self._chain_hashes[-1], _digest(block)))

    def _take(self, name: str, place: list[str], block: str) -> str | None:
        """Remove the block from the chain, deque or stack. Return the reason if the removal is impossible, and None if
        it succeeds.
        """
        end = 0 if name == "deque" else -1
        in_turn = bool(place) and place[end] == block
        if in_turn:
            place.pop(end)
        elif block in place:
            place.remove(block)
        else:
            return f"{block[:12]} leaves the {name}, but was not in it"
        self._copies[block] -= 1
        if name == "chain":
            if block in self._completed:
                self._not_in_chain[block] = None
            if self._chain_hashes is not None:
                del self._chain_hashes[len(place) + 1 :]
        if in_turn or name == "stack":
            return None
        return f"{block[:12]} leaves the {name}, but is not {'in front' if name == 'deque' else 'on top'}"

    def compare(self, line: int, run: HandlerRun) -> bool:
        """Compare the state in the trace line with the state that follows from all changes up to this line. Return true
        if they are equal.
        """
        incarnation, state = self._incarnation, run.state
        if (state.chain, state.deque, state.stack) != (
            len(incarnation.chain),
            len(incarnation.deque),
            len(incarnation.stack),
        ):
            what = (
                f"records that {_lengths(state.chain, state.deque, state.stack)}, but its changes so far lead to "
                f"{_lengths(len(incarnation.chain), len(incarnation.deque), len(incarnation.stack), '')}"
            )
            incarnation.wrong_lengths.append(TraceObservation(line, run, what))
            return False
        if self._chain_hashes is not None and state.top != self._chain_hashes[-1].hex():
            what = f"the top chain hash {state.top[:12]} does not match the {state.chain} blocks of the chain (eq. 3.2)"
            incarnation.wrong_tops.append(
                TraceObservation(line, run, what, incarnation.chain[-1] if incarnation.chain else None)
            )
            return False
        return True

    def idle_too_early(self, line: int, run: HandlerRun) -> TraceObservation:
        incarnation = self._incarnation
        what = f"{len(incarnation.deque)} blocks to be committed and {len(incarnation.stack)} on the reconcile stack"
        return TraceObservation(line, run, what, next(iter(self._not_in_chain), None))


def _digest(block_hash: str) -> bytes:
    """Return the block hash as bytes. For an invalid hash, return zeros, which are the hash of no block."""
    try:
        return bytes.fromhex(block_hash)
    except ValueError:
        return bytes(HASH_BYTES)


def _lengths(chain: int, deque: int, stack: int, verb: str = "holds ") -> str:
    return f"the chain {verb}{chain} blocks, the deque {deque} and the stack {stack}"

"""Compute the history of a run from traces: votes, reconciles and commits of each agent, and the messages between
agents.

The traces are the only source. A vote or reconcile that is in progress ends when its agent is lost, or when the run
ends.
"""

import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Literal, NamedTuple

from harness.archive.run_record import FaultRecord
from harness.archive.traces import Trace
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

LATEST_S = 1e7
"""Latest possible mission second. Handler runs with a later time are omitted, because no mission is that long."""

PhaseName = Literal["phase 1", "phase 2", "phase 3", "finalize"]
PHASES: dict[str, PhaseName] = {
    "reconcile_phase_1": "phase 1",
    "reconcile_phase_2": "phase 2",
    "reconcile_phase_3": "phase 3",
    "reconcile_finalize": "finalize",
}
"""Handler -> the phase of a reconcile that the handler begins."""

CUT_SHORT = "cut short"
COMMITTED_BY = {
    "vote_timer_expiration": "voted for",
    "receive_commit_block": "heard",
    "reconcile_phase_3": "from its stack",
    "receive_response_block_for_hash": "fetched",
    "reconcile_finalize": "put back",
}
"""Handler -> the origin of the block that the handler commits, as reports show it."""
REASONS = {
    "vote_timer_expiration": "vote not approved",
    "receive_request_next_in_sequence": "chain diverged",
}
"""Handler -> the reason why the handler begins a reconcile."""


@dataclass(frozen=True, slots=True)
class AgentVote:
    """The vote of an agent on its own block, with times in mission seconds.

    `outcome` is the branch of Algorithm 5, or CUT_SHORT.
    """

    agent: int
    block: str
    start_s: float
    end_s: float
    outcome: str


@dataclass(frozen=True, slots=True)
class ReconcilePhase:
    """A phase of a reconcile, and the number of message rounds in this phase."""

    name: PhaseName
    start_s: float
    end_s: float
    rounds: int


@dataclass(frozen=True, slots=True)
class AgentReconcile:
    """A reconcile of an agent, with times in mission seconds.

    The `phases` follow each other without a gap. `done` is false if the reconcile was interrupted.
    """

    agent: int
    start_s: float
    end_s: float
    reason: str
    phases: list[ReconcilePhase]
    done: bool


@dataclass(frozen=True, slots=True)
class BlockCommit:
    """The commit of a block: the agent appended the block to its chain. `how` is one of the values of COMMITTED_BY."""

    agent: int
    at_s: float
    block: str
    how: str


@dataclass(frozen=True, slots=True)
class Phase2Tie:
    """A tie at the end of reconcile phase 2: several candidate blocks have the same highest number of votes. `branch`
    is the branch that the handler of Algorithm 15 took.
    """

    agent: int
    at_s: float
    branch: str


class ActivityStart(NamedTuple):
    """The start of a vote, of a reconcile, or of a phase of a reconcile.

    `detail` is the hash of the block, the reason of the reconcile, or the name of the phase.
    """

    what: Literal["vote", "reconcile", "phase"]
    at_s: float
    detail: str


HistoryEvent = ActivityStart | AgentVote | AgentReconcile | Phase2Tie | BlockCommit
"""One entry in the history of an agent. A handler run can cause several entries."""


@dataclass(frozen=True, slots=True)
class BroadcastMessage:
    """A broadcast message with its receivers."""

    sender: int
    at_s: float
    name: str
    block: str | None
    receipts: list[tuple[int, float]] = field(default_factory=list)
    """The ID of the agent and the mission second of each handler run that the message triggered."""
    seq: int = 0
    """The sequence number of the message."""


@dataclass(frozen=True, slots=True)
class MissionHistory:
    """The history of all agents. Each list is sorted by agent, and then by time. `messages` is None if the caller did
    not request messages.
    """

    votes: list[AgentVote]
    reconciles: list[AgentReconcile]
    commits: list[BlockCommit]
    ties: list[Phase2Tie]
    messages: list[BroadcastMessage] | None


def has_possible_time(run: HandlerRun) -> bool:
    """Return true if the recorded time of a handler run is possible."""
    return 0 <= run.t <= LATEST_S


def incarnations(trace: Trace) -> list[list[HandlerRun]]:
    """Return the handler runs of each incarnation of an agent (the time between two restarts). Runs with an impossible
    time are omitted.
    """
    return [[run for _, run in runs if has_possible_time(run)] for runs in trace.incarnations()]


def history_of(
    traces: Mapping[int, Trace], faults: Iterable[FaultRecord], end_s: float, *, whole: bool = True
) -> MissionHistory:
    """Return the history of a run that ended at mission second `end_s`. If `whole` is false, messages are omitted."""
    ends: dict[int, list[float]] = defaultdict(list)
    for fault in faults:
        if fault.kind.ends_incarnation:
            for agent in fault.agents or ():
                ends[agent].append(fault.at_s)
    history = MissionHistory([], [], [], [], [] if whole else None)
    for agent, trace in sorted(traces.items()):
        every = [runs for runs in incarnations(trace) if runs]
        for runs, later in zip_longest(every, every[1:]):
            known = [at_s for at_s in ends[agent] if at_s >= runs[-1].t]
            incarnation = HistoryReader(agent)
            for run in runs:
                _append(history, incarnation.feed(run))
            _append(history, incarnation.end(min([*known, later[0].t if later else end_s])))
    return replace(history, messages=_messages(traces)) if whole else history


def _append(history: MissionHistory, steps: Iterable[HistoryEvent]) -> None:
    for step in steps:
        match step:
            case AgentVote():
                history.votes.append(step)
            case AgentReconcile():
                history.reconciles.append(step)
            case Phase2Tie():
                history.ties.append(step)
            case BlockCommit():
                history.commits.append(step)


class HistoryReader:
    """A reader of the handler runs of one incarnation of an agent (the time between two restarts), one run after
    another.

    The report and the live page both use this class, so that both show the same start and end of each vote and
    reconcile. A vote ends when its timer expires. A reconcile that begins before this time does not end the vote.
    """

    def __init__(self, agent: int) -> None:
        self._agent = agent
        self._now_s = 0.0
        self._vote: tuple[str, float] | None = None
        self._reconcile: tuple[str, float] | None = None
        self._phase: tuple[PhaseName, float, int] | None = None
        self._phases: list[ReconcilePhase] = []

    def feed(self, run: HandlerRun) -> Iterator[HistoryEvent]:
        """Process the next handler run. Yield the parts of the history, such as votes and reconciles, that begin or end
        with this handler run.
        """
        self._now_s = run.t
        if run.handler == "process_next_deque_block" and run.branch == "proposed":
            self._vote = next((sent.block or "" for sent in run.sent), ""), run.t
            yield ActivityStart("vote", run.t, self._vote[0])
        elif run.handler == "vote_timer_expiration":
            yield from self._end_vote(run.t, run.branch)
        elif run.handler == "reconcile_begin" and run.branch == "begun":
            self._reconcile = REASONS.get(str(run.trigger.subject), "asked by the operator"), run.t
            yield ActivityStart("reconcile", run.t, self._reconcile[0])
        elif self._reconcile is not None:
            yield from self._continue_reconcile(run)
        for operation, block in run.changes:
            if operation == "chain+":
                yield BlockCommit(self._agent, run.t, block, COMMITTED_BY.get(run.handler, "otherwise"))

    def end(self, at_s: float) -> Iterator[HistoryEvent]:
        """Yield the vote and the reconcile that were interrupted because the agent ended at `at_s`."""
        at_s = max(at_s, self._now_s)
        yield from self._end_vote(at_s, CUT_SHORT)
        yield from self._end_reconcile(at_s, done=False)

    def _end_vote(self, at_s: float, outcome: str) -> Iterator[AgentVote]:
        if self._vote is not None:
            block, since_s = self._vote
            self._vote = None
            yield AgentVote(self._agent, block, since_s, max(at_s, since_s), outcome)

    def _continue_reconcile(self, run: HandlerRun) -> Iterator[HistoryEvent]:
        """Process a handler run during a reconcile. Yield the parts of the history, such as a phase, that begin or end
        with this handler run.
        """
        if run.branch.startswith("tie:"):
            yield Phase2Tie(self._agent, run.t, run.branch)
        if run.handler == "reconcile_finalize" and run.branch == "done":
            yield from self._end_reconcile(run.t, done=True)
        elif name := PHASES.get(run.handler):
            if self._phase is not None and self._phase[0] == name:
                self._phase = name, self._phase[1], self._phase[2] + 1
            else:
                self._end_phase(run.t)
                self._phase = name, run.t, 1
                yield ActivityStart("phase", run.t, name)

    def _end_phase(self, at_s: float) -> None:
        if self._phase is not None:
            name, since_s, rounds = self._phase
            if at_s > since_s:
                self._phases.append(ReconcilePhase(name, since_s, at_s, rounds))
            self._phase = None

    def _end_reconcile(self, at_s: float, *, done: bool) -> Iterator[AgentReconcile]:
        self._end_phase(at_s)
        if self._reconcile is not None:
            reason, since_s = self._reconcile
            phases, self._reconcile, self._phases = self._phases, None, []
            yield AgentReconcile(self._agent, since_s, max(at_s, since_s), reason, phases, done)


def _messages(traces: Mapping[int, Trace]) -> list[BroadcastMessage]:
    """Return all messages with their receivers. After a restart, an agent uses sequence numbers again. If several
    messages of a sender have the same sequence number, a reception therefore belongs to the last one that was sent
    before it.
    """
    sent: dict[tuple[object, object], list[BroadcastMessage]] = defaultdict(list)
    for agent, trace in sorted(traces.items()):
        for run in trace.runs:
            if has_possible_time(run):
                for broadcast in run.sent:
                    message = BroadcastMessage(agent, run.t, broadcast.message, broadcast.block, seq=broadcast.seq)
                    sent[agent, broadcast.seq].append(message)
    for agent, trace in sorted(traces.items()):
        for run in trace.runs:
            if not isinstance(run.trigger, MessageTrigger):
                continue
            same_number = sent.get((run.trigger.sender, run.trigger.sequence))
            if same_number and has_possible_time(run):
                sent_before = bisect_right([message.at_s for message in same_number], run.t)
                same_number[max(sent_before - 1, 0)].receipts.append((agent, run.t))
    return sorted(
        (message for messages in sent.values() for message in messages),
        key=lambda message: (message.at_s, message.sender),
    )


def end_of_traces(traces: Mapping[int, Trace]) -> float:
    """Return the mission second of the last handler run in all traces. Return 0 if there is no handler run."""
    return max((run.t for trace in traces.values() for run in trace.runs if has_possible_time(run)), default=0.0)


def possible_faults(faults: Iterable[FaultRecord]) -> list[FaultRecord]:
    """Return the faults with a possible time, in order of time."""
    return sorted(
        (fault for fault in faults if math.isfinite(fault.at_s) and 0 <= fault.at_s <= LATEST_S),
        key=lambda fault: fault.at_s,
    )

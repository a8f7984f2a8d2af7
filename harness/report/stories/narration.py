"""Describe the actions of agents as text, in order of time. Actions of the same moment are ordered from causes to
effects.

In a real network, the receivers of a message handle it in random order. The text must not depend on this order. Within
an instant, actions are therefore ordered by their distance from the first cause, and then by agent ID. For example, a
timer expires and an agent sends a query, then all receivers answer, then the agent counts the answers. Agents with
equal actions for equal reasons share one line.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from math import floor, inf, isfinite

from harness.archive.history import has_possible_time
from harness.archive.traces import Trace
from harness.report.stories.story_file import StorySection
from harness.report.stories.story_names import ANSWERS, INCEPTION, LocalChain, StoryNames, message_text
from ucp.agent import HANDLERS
from ucp.trace import HandlerRun, SentMessage
from ucp.trigger import LocalTrigger, MessageTrigger, TimerTrigger

INSTANT_S = 1.5
"""Maximum number of mission seconds between a cause and its effect in the same instant. A timer that is late by at most
this time counts as punctual. The limit leaves room for slow machines, because the lateness of timers in mission seconds
grows with the speedup.
"""


@dataclass
class AgentReaction:
    """An action of an agent: all handler runs that followed from one input."""

    agent_id: int
    position: int
    """Index of the action's first handler run in the agent's trace."""
    runs: list[HandlerRun]
    cause: "AgentReaction | None" = None
    """The action of another agent that sent the triggering message, or None if no message triggered this action."""
    receivers: dict[int, set[int]] = field(default_factory=lambda: defaultdict(set))
    """The receivers of each message that the action sent, by the sequence number of the message."""
    at_s: float = 0.0
    """Mission second of the first cause of this action. If timers expired late, their lateness is subtracted."""
    distance: int = 0
    """Number of messages on the way from the first cause in the same instant to this action."""

    @property
    def instant(self) -> int:
        return floor(self.at_s)

    @property
    def sender(self) -> int | None:
        trigger = self.runs[0].trigger
        return trigger.sender if isinstance(trigger, MessageTrigger) else None

    @property
    def answer(self) -> MessageTrigger | None:
        """The trigger of the action if the action received an answer to a query or request. None otherwise."""
        trigger = self.runs[0].trigger
        return trigger if isinstance(trigger, MessageTrigger) and trigger.message in ANSWERS else None

    def message(self, sequence: int) -> SentMessage | None:
        """Return the message with this sequence number. Return None if the action did not send it."""
        return next((sent for run in self.runs for sent in run.sent if sent.seq == sequence), None)

    @property
    def has_effect(self) -> bool:
        """True if the action changed the agent's blocks or sent a message."""
        return len(self.runs) > 1 or any(run.changes or run.sent for run in self.runs)

    @property
    def answers_another_agent(self) -> bool:
        """True if the action received an answer that another agent needed. Answers are broadcasts, so all agents
        receive each answer.
        """
        if self.answer is None or self.cause is None:
            return False
        asked_by = self.cause.sender
        return asked_by is not None and asked_by != self.agent_id and not self.has_effect


class StoryWriter:
    """A writer of stories. A story is a text that describes a mission step by step. The writer uses the traces of all
    agents.
    """

    def __init__(self, traces: Mapping[int, Trace], roster: Sequence[int]) -> None:
        self._traces = traces
        self._roster = roster
        self._names = StoryNames(traces)
        self._actions = sorted(
            (action for action in _actions_with_causes(traces) if not action.answers_another_agent),
            key=lambda action: (action.instant, action.distance, action.agent_id, action.sender or 0, action.position),
        )

    def answer(self, section: StorySection, *, first: bool = False) -> list[str]:
        """Return the lines for one section of the story. If `first` is true, the lines also describe the actions before
        the section.
        """
        from_s = 0 if first else section.from_s
        actions = [
            action for action in self._actions if from_s <= action.instant and _before(action.instant, section.until_s)
        ]
        lines: list[str] = []
        for instant, of_instant in groupby(actions, key=lambda action: action.instant):
            lines += [f"at {instant} s", *self._instant([*of_instant])]
        return [*lines, *(self._chains(section.until_s) if section.shows_chains else [])]

    def _instant(self, actions: Sequence[AgentReaction]) -> Iterator[str]:
        """Yield the lines for all actions at one instant. Agents with equal actions share their lines."""
        equal: dict[tuple[int, int, object], list[AgentReaction]] = {}
        for action in actions:
            key = action.distance, action.agent_id, self._kind(action)
            if action.has_effect and any(other.has_effect for other in equal.get(key, ())):
                key = action.distance, action.agent_id, action.position
            equal.setdefault(key, []).append(action)
        together: dict[tuple[int, tuple[str, ...]], list[int]] = {}
        for (distance, agent_id, _), equals in equal.items():
            together.setdefault((distance, tuple(self._lines(equals))), []).append(agent_id)
        for (_, lines), agents in together.items():
            yield from (f"  {_listed(agents):<10}{line}" for line in lines)

    def _kind(self, action: AgentReaction) -> object:
        """Return a key for an action. The story describes actions of one agent with the same key together.

        Actions that handle equal answers have the same key. Equal answers arrive in random order, and only the first
        one has an effect. The text must not depend on this order.
        """
        run = action.runs[0]
        if action.cause is None or action.answer is None:
            return action.position
        sent = action.cause.message(action.answer.sequence)
        return run.handler, message_text(sent, self._names) if sent else run.branch

    def _lines(self, equal: Sequence[AgentReaction]) -> Iterator[str]:
        """Yield a line for each handler run, with the algorithm, the name of the handler, the branch in the algorithm,
        the changes and the messages.

        If several equal answers share their lines, the first line lists the branches of all answers in order.
        """
        sender = [action.sender for action in equal if action.sender is not None]
        in_order = sorted(equal, key=lambda action: action.position)
        action = next((action for action in in_order if action.has_effect), in_order[0])
        branches = ", ".join(dict.fromkeys(action.runs[0].branch for action in in_order))
        for number, run in enumerate(action.runs):
            handler = HANDLERS.get(run.handler)
            title = handler.title.partition(" ")[2] if handler else run.handler
            if number == 0 and sender:
                title += f" from {_listed(sender)}"
            rest = [branches if number == 0 else run.branch]
            if run.changes:
                rest.append(", ".join(self._change(operation, block) for operation, block in run.changes))
            rest[-1] += "".join(
                f" -> {message_text(sent, self._names)}{self._missing_receivers(action, sent)}" for sent in run.sent
            )
            yield f" {run.algorithm:>2}  {title}: {'; '.join(rest)}"

    def _change(self, operation: str, block: str) -> str:
        name = self._names.block(block)
        return f"completes {name}" if operation == "complete" else f"{operation[:-1]} {operation[-1]}{name}"

    def _missing_receivers(self, action: AgentReaction, sent: SentMessage) -> str:
        """Return a note about the agents that did not receive a message, although they should have received it. An
        answer should only reach the agent that sent the query.
        """
        meant = {action.sender} if sent.message in ANSWERS else {*self._roster} - {action.agent_id}
        missed = sorted(agent for agent in meant - action.receivers[sent.seq] if agent is not None)
        return f", not to {_listed(missed)}" if missed else ""

    def _chains(self, until_s: int | None) -> list[str]:
        """Return the chains of all agents as a tree of blocks. Each branch of the tree ends with the agents whose
        chains end there.
        """
        chains: dict[int, list[str]] = {}
        for agent_id, trace in self._traces.items():
            positions = {action.position: action.instant for action in self._actions if action.agent_id == agent_id}
            chain, instant = LocalChain(trace), 0
            for position, run in enumerate(trace.runs):
                instant = positions.get(position, instant)
                if not _before(instant, until_s):
                    break
                if position in trace.starts:
                    chain = LocalChain(trace)
                chain.replay(run)
            chains[agent_id] = self._names.of(chain.blocks)
        if not chains:
            return ["no chains: no agent has a trace"]
        return ["chains", *_tree({agent_id: [INCEPTION, *chain] for agent_id, chain in chains.items()}, "  ")]


def _actions_with_causes(traces: Mapping[int, Trace]) -> list[AgentReaction]:
    """Return all actions of all agents. The cause of an action is the action that sent the triggering message."""
    actions = [action for agent_id, trace in traces.items() for action in _actions(agent_id, trace)]
    sent: dict[tuple[int, int], list[AgentReaction]] = defaultdict(list)
    for action in actions:
        for run in action.runs:
            for message in run.sent:
                sent[action.agent_id, message.seq].append(action)
    due: dict[tuple[int, object], float] = {}
    """The mission second at which each timer should expire, by agent ID and timer."""
    for action in sorted(actions, key=lambda action: (action.runs[0].t, action.agent_id, action.position)):
        run = action.runs[0]
        timer = run.trigger.timer if isinstance(run.trigger, TimerTrigger) else None
        timer_ends_s = due.get((action.agent_id, timer), -inf)
        action.at_s = timer_ends_s if run.t - timer_ends_s < INSTANT_S else run.t
        if action.sender is not None:
            _set_cause(action, sent)
        for run in action.runs:
            due |= {
                (action.agent_id, timer): action.at_s + lasts_s
                for timer, lasts_s in (run.started or {}).items()
                if isfinite(lasts_s)
            }
    return actions


def _set_cause(action: AgentReaction, sent: Mapping[tuple[int, int], Sequence[AgentReaction]]) -> None:
    """Record the cause of this action: the action that sent the triggering message."""
    run = action.runs[0]
    if not isinstance(run.trigger, MessageTrigger):
        return
    sender, sequence = run.trigger.sender, run.trigger.sequence
    earlier = [cause for cause in sent.get((sender, sequence), ()) if cause.runs[0].t < run.t]
    if earlier:
        cause = action.cause = max(earlier, key=lambda cause: cause.runs[0].t)
        cause.receivers[sequence].add(action.agent_id)
        if run.t - cause.runs[0].t < INSTANT_S:
            action.at_s, action.distance = cause.at_s, cause.distance + 1


def _actions(agent_id: int, trace: Trace) -> Iterator[AgentReaction]:
    """Yield the actions in a trace. If one handler run triggered another, both belong to the same action."""
    action: AgentReaction | None = None
    for position, run in enumerate(trace.runs):
        if not has_possible_time(run):
            continue
        if isinstance(run.trigger, LocalTrigger) and action is not None:
            action.runs.append(run)
            continue
        if action is not None:
            yield action
        action = AgentReaction(agent_id, position, [run])
    if action is not None:
        yield action


def _tree(chains: Mapping[int, Sequence[str]], indent: str) -> Iterator[str]:
    """Yield a line that shows the blocks with which all chains begin. Below this line, yield an indented tree for each
    different continuation.
    """
    common = 0
    while all(len(chain) > common for chain in chains.values()) and (
        len({chain[common] for chain in chains.values()}) == 1
    ):
        common += 1
    ends = [agent_id for agent_id, chain in chains.items() if len(chain) == common]
    blocks = next(iter(chains.values()))[:common]
    yield f"{indent}{' '.join(blocks)}{f'  ({_listed(ends)})' if ends else ''}"
    branches: dict[str, dict[int, Sequence[str]]] = {}
    for agent_id, chain in chains.items():
        if len(chain) > common:
            branches.setdefault(chain[common], {})[agent_id] = chain[common:]
    for branch in branches.values():
        yield from _tree(branch, indent + "  ")


def _before(instant: int, until_s: int | None) -> bool:
    return until_s is None or instant < until_s


def _listed(agents: Sequence[int]) -> str:
    return " ".join(map(str, agents))

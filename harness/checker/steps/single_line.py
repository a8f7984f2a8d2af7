"""Decide whether damage to a few lines of a trace explains a difference from the reference.

A file from the field may lack a line, or contain a damaged line that is still readable. The difference then does not
prove a mistake of the agent. The module tries five kinds of damage:

- One character of the line is wrong, or the line contradicts itself.
- The line is the beginning of one line and the end of a later line. The part of the file between them is missing.
- The line and the next line are in the wrong order.
- The line before this line is missing. The missing handler run changed no block, so no recorded state reveals it.
- Several lines before this line are missing. They contained answers to one question, which often arrive together. One
  of them may have contained the expiry of the timer of this question.

An explanation counts only if the reference, after this correction, agrees with the lines that follow.
"""

import base64
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from itertools import combinations_with_replacement
from typing import Protocol

from harness.archive.vocabulary import branch_is_known
from harness.checker.recorded_inputs import NotOnRecordError, decoded, event_of
from harness.checker.reference.algorithms import HANDLERS, ON_MESSAGE, ON_TIMER
from harness.checker.reference.state import ReferenceState
from harness.checker.steps.deviation import StepDeviation
from harness.checker.steps.follower import EVENT_OF, LOGS, StepComparer
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import (
    BlockAddResponse,
    ChainContainResponse,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    encode,
)
from ucp.trace import HandlerRun, RecordedBytes, SentMessage
from ucp.trigger import EventTrigger, LocalTrigger, MessageTrigger, TimerTrigger

Line = tuple[int, HandlerRun]
"""A handler run with its line number."""


class OtherRecords(Protocol):
    """The records of a flight that help to judge a damaged trace: those of all other agents, and some facts about the
    judged agent and its trace file.
    """

    def datagrams(self, sender: int, sequence: int) -> list[bytes]:
        """Return the recorded datagrams with this sender and this sequence number."""

    def sent_by_others(self, kind: str) -> Iterable[tuple[int, Message]]:
        """Return each different message of this type that other agents sent according to their records, with its
        sender.
        """

    def may_have_arrived(self, sender: int, message: Message, at_s: float) -> bool:
        """Return false if the records of other agents prove that the agent received no message of this kind from
        `sender` before this time.
        """

    def was_reconciling(self, at_s: float) -> bool:
        """Return true if the agent was reconciling at its last trace line before this mission second."""

    def beginnings(self, number: int) -> Iterable[str]:
        """Return the possible beginnings of line `number` of the trace file, if damage can cut the line only at the end
        of a disk block. The result is empty if the whole line is inside one disk block.
        """


LINES_AFTER = 8
"""Number of trace lines after the difference that must agree with the reference after the correction."""
JOINED = "a part of the file is missing, and the line is joined from two lines"
"""The phrase for the damage to a line that consists of the beginning of one line and the end of a later line."""
MAX_FURTHER = 2
"""Maximum number of further lines that may be missing among the lines after the difference."""
MAX_ANSWERS = 4
"""Maximum number of consecutive lost lines with answers to one question."""
COUNTS = frozenset(ON_MESSAGE[kind].name for kind in (BlockAddResponse, ChainContainResponse, NextInSequenceResponse))
"""Names of the handlers that count answers."""
_MESSAGES = {handler.name: kind.NAME for kind, handler in ON_MESSAGE.items()}
"""Name of a handler of messages -> the type of its messages."""
MAX_LOCAL = 4
"""Maximum number of consecutive lost lines about handler runs that local events triggered."""


def damage_that_explains(
    before: StepComparer, deviation: StepDeviation, line: Line, following: Sequence[Line], others: OtherRecords
) -> str | None:
    """Return a phrase for the damage to a trace that explains the difference, such as "a line is missing". Return None
    if no damage explains it.

    `before` is the comparison in its state before the damaged line. The function does not change this object.
    """
    following = following[:LINES_AFTER]
    if _is_one_character_off(before, deviation, line, following, others):
        return "one character of the line is damaged"
    if following and _agrees(before.copy(), [following[0], line, *following[1:]]):
        return "two lines are in the wrong order"
    if (damage := _damage_to_events(before, line[1])) is not None:
        return damage
    if _completes_unknown_block(before, deviation, line[1]):
        return "a line is missing (its block may have an event that no line logs, and no record has the block)"
    if _has_impossible_top(before, deviation, line, following):
        return "the top chain hash on the line is damaged"
    if _contradicts_itself(line[1], before.state.agent_id, others):
        return "the line is damaged"
    if _is_joined(deviation, line, others):
        return JOINED
    for trial in _with_a_line_more(before, line[1], others):
        if _agrees(trial, [line, *following], others):
            return "a line is missing"
    for trial in _with_lines_more(before, [line[1], *(run for _, run in following)], others):
        if _agrees(trial, [line, *following]):
            return "lines are missing"
    return None


def _agrees(
    follower: StepComparer, lines: Sequence[Line], others: OtherRecords | None = None, lost: int = MAX_FURTHER
) -> bool:
    """Return true if the reference agrees with the lines. If `others` is given, the reference may add up to `lost`
    handler runs whose lines were lost.

    The comparison ends early, with the result true, at a block whose recorded events differ from the logged events.
    Another lost line may be the cause of this difference.
    """
    start = None if others is None or not lost else follower.copy()
    for place, (number, run) in enumerate(lines):
        if number > lines[0][0] and _damage_to_events(follower, run) is not None:
            return True
        follower.follow(number, run)
        if follower.deviations or follower.lost:
            if not place or start is None or others is None:
                return False
            for earlier in lines[:place]:
                start.follow(*earlier)
            trials = _with_a_line_more(start, run, others)
            return any(_agrees(trial, lines[place:], others, lost - 1) for trial in trials)
    return True


# One damaged character


def _is_one_character_off(
    before: StepComparer, deviation: StepDeviation, line: Line, following: Sequence[Line], others: OtherRecords
) -> bool:
    number, run = line
    text = run.to_line()
    return any(
        _differ_in_one_character(text, other.to_line()) and _agrees(before.copy(), [(number, other), *following])
        for other in _as_it_may_have_been(before, deviation, run, others)
    )


def _as_it_may_have_been(
    before: StepComparer, deviation: StepDeviation, run: HandlerRun, others: OtherRecords
) -> Iterator[HandlerRun]:
    expected = deviation.expected
    if expected is not None and deviation.run is run and not _was_received(before, expected, run, others):
        yield _with_recorded_input(expected, run)
    if isinstance(run.trigger, MessageTrigger):
        try:
            sender, sequence, message = decoded(run.input)
            other = copy(run)
            other.trigger = MessageTrigger(message.NAME, sender, sequence)
            yield other
        except MalformedDatagramError:
            pass
        texts = [base64.b64encode(data).decode() for data in others.datagrams(run.trigger.sender, run.trigger.sequence)]
        texts += [
            base64.b64encode(encode(run.trigger.sender, run.trigger.sequence, message)).decode()
            for message in _answers(before.state, run, others)
        ]
        for text in texts:
            other = copy(run)
            other.input = RecordedBytes(text)
            yield other
    for timer in before.state.timers:
        if timer.deadline is not None:
            deadline_s = before.mission_s(timer.deadline)
            for digits in (3, 4, 5, 6):
                other = copy(run)
                other.t = round(deadline_s, digits)
                yield other


def _was_received(before: StepComparer, expected: HandlerRun, run: HandlerRun, others: OtherRecords) -> bool:
    """Return true if the line contains a sent message that differs from the expected ones, and another agent received
    this message. The agent then really sent the message, so the line is not damaged.
    """
    sent_by_both = [sent.datagram for sent in expected.sent]
    return any(
        sent.datagram is not None
        and sent.datagram not in sent_by_both
        and _was_received_as(sent, before.state.agent_id, others)
        for sent in run.sent
    )


def _differ_in_one_character(text: str, other: str) -> bool:
    return len(text) == len(other) and sum(ours != theirs for ours, theirs in zip(text, other, strict=True)) == 1


def _has_impossible_top(before: StepComparer, deviation: StepDeviation, line: Line, following: Sequence[Line]) -> bool:
    """Return true if the top chain hash on the line is damaged: the recorded state differs from the expected state only
    in this hash, and the next lines agree with the expected hash.

    Such a line may also come immediately before lost lines, because damage can join the beginning of a line with the
    end of a later line.
    """
    number, run = line
    expected = deviation.expected
    if expected is None or deviation.run is not run or expected.state == run.state:
        return False
    other = copy(run)
    other.state = expected.state
    alike = copy(run.state)
    alike.top = expected.state.top
    return alike == expected.state and _agrees(before.copy(), [(number, other), *following])


def _contradicts_itself(run: HandlerRun, agent_id: int, others: OtherRecords) -> bool:
    """Return true if parts of the line contradict each other: the name of the handler, its number and its trigger, or a
    datagram and the name of its message. An invalid datagram is also a contradiction.

    If another agent received the invalid datagram, the agent really sent it, so the line is correct.
    """
    if _names_another_handler(run):
        return True
    if isinstance(run.trigger, MessageTrigger) and _sent_message(run.input) is None:
        return True
    for sent in run.sent:
        if sent.datagram is None:
            continue
        whole = _sent_message(sent.datagram)
        if whole is None and not _was_received_as(sent, agent_id, others):
            return True
        if whole is not None and (whole.message, whole.seq, whole.block) != (sent.message, sent.seq, sent.block):
            return True
    return False


def _is_joined(deviation: StepDeviation, line: Line, others: OtherRecords) -> bool:
    """Return true if the line may consist of the beginning of one line and the end of a later line.

    A lost disk block joins two lines in this way, so the join must be at the beginning of a disk block. The line must
    be as expected before the join, or its branch must be unknown. Only few lines contain the beginning of a disk block,
    so this damage cannot explain repeated mistakes of an agent.
    """
    number, run = line
    if deviation.expected is None or deviation.run is not run:
        return False
    expected = _with_recorded_input(deviation.expected, run).to_line()
    unknown = not branch_is_known(run)
    return any(unknown or expected.startswith(beginning) for beginning in others.beginnings(number))


def _with_recorded_input(expected: HandlerRun, run: HandlerRun) -> HandlerRun:
    """Return the expected handler run with the recorded input. The reference does not compute inputs."""
    other = copy(expected)
    other.input, other.sealed, other.started = run.input, run.sealed, other.started or None
    return other


def _names_another_handler(run: HandlerRun) -> bool:
    """Return true if the line has the name of one handler, but the number or the trigger of another handler.

    Such a line can be the beginning of one line and the end of a later line.
    """
    handler = HANDLERS.get(run.handler)
    if handler is None:
        return False
    if handler.algorithm != run.algorithm:
        return True
    trigger = run.trigger
    if isinstance(trigger, MessageTrigger):
        return _MESSAGES.get(run.handler) != trigger.message
    if isinstance(trigger, EventTrigger):
        return run.handler != LOGS
    if isinstance(trigger, TimerTrigger):
        return handler not in ON_TIMER.values()
    return isinstance(trigger, LocalTrigger) and run.handler not in EVENT_OF


def _sent_message(datagram: RecordedBytes | None) -> SentMessage | None:
    """Return the message in a datagram. Return None if the datagram is invalid."""
    try:
        return SentMessage.of(*decoded(datagram))
    except MalformedDatagramError:
        return None


def _was_received_as(sent: SentMessage, agent_id: int, others: OtherRecords) -> bool:
    """Return true if another agent received exactly this datagram."""
    assert sent.datagram is not None
    try:
        data = base64.b64decode(sent.datagram.text, validate=True)
    except ValueError:
        return False
    return data in others.datagrams(agent_id, sent.seq)


# A missing line


def _damage_to_events(before: StepComparer, run: HandlerRun) -> str | None:
    """Return a phrase for the damage if the agent completed a block whose events differ from the logged events, and a
    damaged or lost line explains the difference. Return None otherwise.
    """
    completed = next((block_hash for operation, block_hash in run.changes if operation == "complete"), None)
    if run.handler != LOGS or completed is None:
        return None
    try:
        earlier, last = decode_events(bytes(before.state.current_block)), event_of(run.input)
        events = Counter(decode_events(before.block(completed).event_data))
    except (NotOnRecordError, MalformedEventsError):
        return None
    for logged in (Counter([*earlier, last]), Counter(earlier)):  # a full block may lack the last event
        if logged < events:
            return "a line is missing (its block has an event that no line logs)"
        pairs = [*zip((logged - events).elements(), (events - logged).elements(), strict=False)]
        if pairs and all(
            _differ_in_one_character(*(base64.b64encode(event.encode()).decode() for event in pair)) for pair in pairs
        ):
            return "one character of a line is damaged (its block has another event than the line logs)"
    return None


def _completes_unknown_block(before: StepComparer, deviation: StepDeviation, run: HandlerRun) -> bool:
    """Return true if the agent completed a different block than the reference, and no record contains this block. An
    event whose line is lost may then be in the block.
    """
    if deviation.run is not run or deviation.expected is None or run.handler != LOGS or not run.changes:
        return False
    try:
        before.block(run.changes[0][1])
    except NotOnRecordError:
        return True
    return False


def _with_a_line_more(before: StepComparer, run: HandlerRun, others: OtherRecords) -> Iterator[StepComparer]:
    """Yield copies of the reference. Each copy has made another additional handler run, which may be the one on the
    lost line.
    """
    yield from _with_local_events_more(before, run)
    yield from _with_an_expiry_more(before, run, others)
    for message in _answers(before.state, run, others):
        for sender in sorted(before.roster - {before.state.agent_id}):
            if others.may_have_arrived(sender, message, run.t):
                trial = before.copy()
                if trial.play_lost_message(sender, message, run.t):
                    yield trial
    if isinstance(run.trigger, LocalTrigger) and run.trigger.handler in _MESSAGES:
        for sender, message in others.sent_by_others(_MESSAGES[run.trigger.handler]):
            trial = before.copy()
            if trial.play_lost_message(sender, message, run.t):
                yield trial


def _with_local_events_more(before: StepComparer, run: HandlerRun) -> Iterator[StepComparer]:
    """Yield copies of the reference after one, two or more of the waiting local events, up to `MAX_LOCAL`."""
    trial = before.copy()
    for _ in range(MAX_LOCAL):
        if not trial.play_lost_local_event(run.t):
            break
        yield trial.copy()


def _with_an_expiry_more(before: StepComparer, run: HandlerRun, others: OtherRecords) -> Iterator[StepComparer]:
    """Yield copies of the reference after the expiry of a timer, and after the local events that the handler of the
    timer triggers.

    Algorithm 5, Vote Timer Expiration, does nothing during a reconcile. If its trace line is lost, the difference
    appears only after the reconcile. The function therefore also yields a copy in which the voting timer is stopped.
    """
    voting = before.state.voting_timer
    due_s = None if voting.deadline is None else before.mission_s(voting.deadline)
    if due_s is not None and due_s <= run.t and others.was_reconciling(due_s):
        trial = before.copy()
        trial.stop_timer(voting.name)
        yield trial
    for timer in before.state.timers:
        trial = before.copy()
        if trial.play_lost_expiry(timer.name, run.t):
            yield trial.copy()
            yield from _with_local_events_more(trial, run)


def _with_lines_more(
    before: StepComparer, following: Sequence[HandlerRun], others: OtherRecords
) -> Iterator[StepComparer]:
    """Yield copies of the reference after answers to its last question whose trace lines are lost. In some copies, the
    timer of the question has also expired, because the line of this expiry can be lost as well.
    """
    for count in range(1, MAX_ANSWERS + 1):
        for trial in _with_answers_more(before, following, others, count):
            if count > 1:
                yield trial
            yield from _with_an_expiry_more(trial, following[0], others)


def _with_answers_more(
    before: StepComparer, following: Sequence[HandlerRun], others: OtherRecords, count: int
) -> Iterator[StepComparer]:
    """Yield copies of the reference after `count` answers whose trace lines are lost. An agent counts only one answer
    of each sender. The senders of lost answers are therefore other agents than the senders of recorded answers.
    """
    run, state = following[0], before.state
    answered = state.voters if state.voting_timer.active else state.reconcile_responders
    silent = sorted(before.roster - {state.agent_id} - answered - _senders(following))
    senders = {
        message: [sender for sender in silent if others.may_have_arrived(sender, message, run.t)]
        for message in _answers(state, run, others)
    }
    for messages in combinations_with_replacement(senders, count):
        assigned = next(_assignments([senders[message] for message in messages]), None)
        if assigned is None:
            continue
        trial = before.copy()
        if all(trial.play_lost_message(*lost, run.t) for lost in zip(assigned, messages, strict=True)):
            yield trial


def _senders(runs: Iterable[HandlerRun]) -> set[int]:
    """Return the senders of the recorded answers to the current question. The first handler run without a message ends
    the search, because the question then has ended.
    """
    senders = set()
    for run in runs:
        if not isinstance(run.trigger, MessageTrigger):
            break
        if run.handler in COUNTS:
            senders.add(run.trigger.sender)
    return senders


def _assignments(choices: Sequence[Sequence[int]]) -> Iterator[tuple[int, ...]]:
    """Yield all ways to choose one element from each sequence, such that no element is chosen twice. Each result is a
    tuple.
    """
    if not choices:
        yield ()
        return
    for rest in _assignments(choices[1:]):
        yield from ((first, *rest) for first in choices[0] if first not in rest)


def _answers(state: ReferenceState, run: HandlerRun, others: OtherRecords) -> Iterator[Message]:
    """Yield the possible answers to the agent's last query or request."""
    top = state.chain.top_chain_hash
    if state.voting_timer.active and state.candidate_block is not None:
        named = state.top_chain_hash_at_initiation if state.settings.vote_names_chain else None
        for approve in (True, False):
            yield BlockAddResponse(state.candidate_block.block_hash, approve, named)
    if state.phase_one_timer.active:
        for contained in (True, False):
            yield ChainContainResponse(top, contained)
    if state.phase_two_timer.active:
        candidates = {b"": 0}
        candidates |= {block_hash: counted[1] for block_hash, counted in state.reconcile_response_dictionary.items()}
        for block_hash, counted in (run.tally or {}).items():
            with suppress(ValueError):
                candidates[bytes.fromhex(block_hash)] = counted[-1] if isinstance(counted, list) else 0
        for _, sent in others.sent_by_others(NextInSequenceResponse.NAME):
            if isinstance(sent, NextInSequenceResponse) and sent.chain_hash == top:
                candidates[sent.block_hash or b""] = sent.timestamp_us
        for candidate, timestamp_us in candidates.items():
            with suppress(ValueError, TypeError):
                yield NextInSequenceResponse(top, candidate or None, timestamp_us)

"""Compare the messages that agents handled with the messages that other agents sent.

An agent handles a message after its sender sent it, with the content that was sent. It handles the message once, unless
the network duplicates messages.
"""

from collections.abc import Iterator

from harness.checker._trace_replay import TraceObservation
from harness.checker.evidence import Evidence, Sending
from harness.checker.records._export_vs_trace import finding
from harness.checker.records.contradiction import Contradiction, slack_s
from ucp.messages import BlockResponse, CommitBlock
from ucp.trace import HandlerRun, RecordedBytes
from ucp.trigger import MessageTrigger

CARRY_A_BLOCK = frozenset((CommitBlock.NAME, BlockResponse.NAME))


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each handled message that differs from the sent message, that was handled before it was sent, or that was
    handled twice.
    """
    slack = max((slack_s(evidence, trace) for trace in evidence.traces.values()), default=0.0)
    sendings = evidence.sendings
    once = not _may_duplicate(evidence)
    for agent_id, incarnations in evidence.incarnations.items():
        handled: dict[tuple[int, str, int], int] = {}
        for incarnation in incarnations:
            for line, run in incarnation.numbered_runs():
                trigger = run.trigger
                if not isinstance(trigger, MessageTrigger):
                    continue
                sent = sendings.get(trigger.sender, {}).get(trigger.message, {}).get(trigger.sequence)
                if sent is None:
                    continue  # characteristic 1 reports messages that no agent sent
                if once:
                    key = trigger.sender, trigger.message, trigger.sequence
                    count = handled[key] = handled.get(key, 0) + 1
                    if count > len(sent) and not evidence.injected.may_include(trigger):
                        what = f"handled {_named(trigger)} again, although nothing duplicates messages"
                        yield Contradiction(finding(evidence, agent_id, TraceObservation(line, run, what)), "1")
                first_s, message = sent[0]
                recorded = message.datagram
                unchanged = recorded is not None and (run.input is recorded or run.input == recorded)
                if unchanged and run.t >= first_s - slack and not run.changes:
                    continue  # most are like this
                if not evidence.injected.may_include(trigger):
                    for observation, touches in _find_differences(line, run, trigger, sent, first_s - slack):
                        yield Contradiction(finding(evidence, agent_id, observation), touches)


def _may_duplicate(evidence: Evidence) -> bool:
    """Return true if a message may arrive twice: the network duplicates messages, the scenario decides the fate of each
    message, or no record describes the network.
    """
    links = evidence.requested_links
    return links is None or evidence.has_fates or any(link.duplicate > 0 for link in links)


def _find_differences(
    line: int, run: HandlerRun, trigger: MessageTrigger, sent: Sending, earliest_s: float
) -> Iterator[tuple[TraceObservation, str]]:
    """Yield each difference between a handled message and the sent message, with the affected characteristic."""
    if run.t < earliest_s:
        yield TraceObservation(line, run, f"handled {_named(trigger)} before it was sent at {sent[0][0]:g} s"), "1"
    if run.input is not None and not _is_unchanged(run.input, sent):
        yield (
            TraceObservation(line, run, f"handled {_named(trigger)}, whose content differs from the sent message"),
            "1",
        )
    elif run.changes and (other := _another_block(run, trigger, sent)):
        yield (
            TraceObservation(
                line, run, f"took this block from {_named(trigger)}, but that message carried another block", other
            ),
            "4",
        )


def _named(trigger: MessageTrigger) -> str:
    return f"{trigger.message} number {trigger.sequence} of agent {trigger.sender}"


def _is_unchanged(datagram: RecordedBytes, sent: Sending) -> bool:
    recorded = [message.datagram for _, message in sent]
    return None in recorded or datagram in recorded


def _another_block(run: HandlerRun, trigger: MessageTrigger, sent: Sending) -> str | None:
    """Return the block that the agent added to its chain if the handled message did not carry this block. Return None
    if the message carried the added block, or if messages of this type carry no block.
    """
    if trigger.message not in CARRY_A_BLOCK:
        return None
    carried = {message.block for _, message in sent}
    return next((block for operation, block in run.changes if operation == "chain+" and block not in carried), None)

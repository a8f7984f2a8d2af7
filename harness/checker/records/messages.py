"""What an agent heard against what others sent: nothing is heard before it is sent, and a block comes as it went."""

from collections.abc import Iterator

from harness.checker.evidence import Evidence, Sending
from harness.checker.records.clocks import slack_s
from harness.checker.records.contradiction import Contradiction
from harness.checker.records.within import finding
from harness.checker.replay import Sight
from ucp.messages import BlockResponse, CommitBlock
from ucp.trace import HandlerRun

CARRY_A_BLOCK = frozenset((CommitBlock.NAME, BlockResponse.NAME))


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    slack = max(map(slack_s, evidence.traces.values()), default=0.0)
    sendings = evidence.sendings
    for agent_id, lives in evidence.lives.items():
        for life in lives:
            for line, run in life.numbered():
                trigger = run.trigger
                if "seq" in trigger:
                    sent = sendings.get(trigger.get("from"), {}).get(trigger.get("message"), {}).get(trigger["seq"])
                    # What nobody sent is characteristic 1's to say.
                    if sent is None or evidence.injected.may_be(trigger):
                        continue
                    if run.t < sent[0][0] - slack:
                        what = f"heard {_named(run)}, which was sent at {sent[0][0]:g} s"
                        yield Contradiction(finding(evidence, agent_id, Sight(line, run, what)), "1")
                    if run.input is not None and not _as_it_went(run.input, sent):
                        what = f"heard {_named(run)} with another content than it was sent with"
                        yield Contradiction(finding(evidence, agent_id, Sight(line, run, what)), "1")
                    elif run.changes and (other := _another_block(run, sent)):
                        what = f"took this block from {_named(run)}, which carried another"
                        yield Contradiction(finding(evidence, agent_id, Sight(line, run, what, other)), "4")


def _as_it_went(datagram: str, sent: Sending) -> bool:
    return any(message.datagram in (None, datagram) for _, message in sent)


def _another_block(run: HandlerRun, sent: Sending) -> str | None:
    """The block that the agent took onto its chain from a message that did not carry it."""
    if run.trigger["message"] not in CARRY_A_BLOCK:
        return None
    carried = {message.block for _, message in sent}
    return next((block for operation, block in run.changes if operation == "chain+" and block not in carried), None)


def _named(run: HandlerRun) -> str:
    return "{message} number {seq} of agent {from}".format(**run.trigger)

"""Test that the checker compares lost messages with the loss rate, for runs in memory and for networks that duplicate
packets.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle

import pytest

from harness.archive.traces import Trace
from harness.checker import Evidence
from harness.checker.records import _losses
from harness.run.simulate import simulate
from tests.harness.virtual import scenario
from ucp.trigger import MessageTrigger

CONDITIONS = [{"loss": 0.3}, {"loss": 0.3, "duplicate": 0.1}, {"loss": 0.9, "duplicate": 0.6}]


@pytest.fixture(scope="module", params=CONDITIONS, ids=str)
def honest(request: pytest.FixtureRequest) -> Evidence:
    """Return the evidence of a run in memory in which the agents receive every message that the network does not
    lose.
    """
    asked = scenario(network=request.param, duration_s=1200, final_reconcile=True)
    evidence = simulate(asked, 1, tracing=True, deliver_all=True).evidence
    return replace(evidence, delivers_all=True)


def kept(trace: Trace, which: Iterator[bool]) -> Trace:
    """Return the trace with only these received messages."""
    runs = [run for run in trace.runs if not isinstance(run.trigger, MessageTrigger) or next(which)]
    return replace(trace, runs=runs)


def found(evidence: Evidence) -> list[str]:
    return [contradiction.finding.detail for contradiction in _losses.compare(evidence)]


def test_correct_run_in_memory_agrees_with_its_loss_rate(honest: Evidence) -> None:
    assert found(honest) == found(replace(honest, delivers_all=False)) == []


def test_run_in_memory_that_discards_messages_is_found(honest: Evidence) -> None:
    which = cycle([True] * 6 + [False])
    discarding = {agent_id: kept(trace, which) for agent_id, trace in honest.traces.items()}
    (detail, *_) = found(replace(honest, traces=discarding))
    assert "of them are lost" in detail


def test_run_in_memory_with_another_loss_rate_is_found(honest: Evidence) -> None:
    less = [(at_s, {link: loss / 2 for link, loss in losses.items()}) for at_s, losses in honest.link_losses]
    assert "of them are lost" in found(replace(honest, link_losses=less))[0]


def test_more_messages_than_the_loss_rate_allows_are_found(honest: Evidence) -> None:
    more = [(at_s, {link: (1 + loss) / 2 for link, loss in losses.items()}) for at_s, losses in honest.link_losses]
    if more != honest.link_losses:
        assert "of them are lost" in found(replace(honest, link_losses=more))[0]


def test_message_over_a_partition_is_expected_from_no_second_copy() -> None:
    asked = scenario(
        network={"loss": 0.2, "duplicate": 0.5},
        duration_s=900,
        timeline=[{"at_s": 100, "partition": [[1, 2]]}, {"at_s": 800, "heal": True}],
    )
    assert found(simulate(asked, 1, tracing=True).evidence) == []

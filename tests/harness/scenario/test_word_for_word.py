"""Test scenario keys that repeat a recorded flight: events, arrivals, late timers, datagrams, and expected chains."""

import base64
from typing import Any

import pytest

from harness.errors import ScenarioError
from harness.run.simulate import Simulated, simulate
from harness.scenario.expect import Expect
from harness.scenario.load import parse
from harness.scenario.strict_model import format_pairs, parse_pairs
from tests.harness.virtual import scenario
from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.events import LoggableEvent
from ucp.messages import CommitBlock, encode

FULL = {"max_block_bytes": 267}
"""Settings with which any event fills a block."""
EVENT = {"at_s": 10, "agent": 1, "event_id": 7, "data": base64.b64encode(b"seen").decode(), "timestamp_us": 123}


def played(**keys: Any) -> Simulated:
    events = {"source": "scripted", "script": [EVENT]}
    asked = {"agents": 2, "settings": FULL, "events": events, "duration_s": 60, **keys}
    return simulate(scenario(**asked), 1, tracing=True)


def times_of(simulated: Simulated, agent: int, handler: str) -> list[float]:
    return [run.t for run in simulated.evidence.traces[agent].runs if run.handler == handler]


def test_recorded_event_and_initial_data_give_the_expected_chain() -> None:
    simulated = played(initial_data=base64.b64encode(b"begin").decode())
    block = Block(1, 123, LoggableEvent(123, 7, b"seen").encode())
    top = next_chain_hash(InceptionBlock(b"begin").chain_hash, block.block_hash).hex()
    assert {export.top_chain_hash for export in simulated.evidence.exports.values()} == {top}
    expect = Expect.model_validate({"chains": {1: top, 2: "0" * 64, 3: top}})
    tops = {agent: export.top_chain_hash for agent, export in simulated.evidence.exports.items()}
    assert [*expect.unexpected_chains(tops)] == [
        f"agent 2 ends with the chain hash {top[:12]} on top, but must end with 000000000000",
        f"agent 3 has no chain, but must end with {top[:12]} on top",
    ]


def test_arrivals_deliver_exactly_the_listed_datagrams() -> None:
    fates = [
        {"sender": 1, "receiver": 2, "arrivals": "0@11.5 0@12.25"},
        {"sender": 2, "receiver": 1, "arrivals": "0@13"},
    ]
    simulated = played(fates=fates)
    assert times_of(simulated, 2, "receive_request_add_block") == [11.5, 12.25]
    assert times_of(simulated, 1, "receive_vote_add_block") == [13.0]
    assert times_of(simulated, 2, "receive_commit_block") == []
    assert simulated.played.unmatched_fates == []


def test_arrival_of_a_datagram_that_was_never_sent_is_reported() -> None:
    simulated = played(fates=[{"sender": 1, "receiver": 2, "arrivals": "0@11 70@12 90@13"}])
    (sentence,) = simulated.played.unmatched_fates
    assert sentence.endswith("2 of its datagrams, the first number 70, never left")


def test_timer_expires_late_by_the_listed_seconds() -> None:
    assert times_of(played(), 1, "vote_timer_expiration") == [20.0]
    assert times_of(played(lateness={1: "0+2.5"}), 1, "vote_timer_expiration") == [22.5]
    assert times_of(played(lateness={1: "1+2.5"}), 1, "vote_timer_expiration") == [20.0]


def test_scripted_datagram_reaches_its_receiver() -> None:
    block = Block(2, 5, LoggableEvent(5, 1, b"x").encode())
    top = next_chain_hash(InceptionBlock(b"").chain_hash, block.block_hash)
    datagram = base64.b64encode(encode(2, 0, CommitBlock(block, top))).decode()
    stray = {"source": 2, "datagram": datagram, "reaches": {1: 3.5}}
    simulated = played(events={"source": "scripted"}, initial_data="", datagrams=[stray])
    assert times_of(simulated, 1, "receive_commit_block") == [3.5]
    assert len(simulated.evidence.exports[1].chain) == 1
    assert simulated.result.characteristics["1"].verdict == "not applicable"
    assert simulated.result.characteristics["4"].verdict == "not applicable"


def test_fault_reconcile_starts_a_reconcile() -> None:
    simulated = played(timeline=[{"at_s": 30, "reconcile": [2]}])
    assert times_of(simulated, 2, "reconcile_begin") == [30.0]


def test_pairs_of_number_and_seconds_survive_writing_and_reading() -> None:
    pairs = [(0, 12.5), (3, 0.000001), (1234567890, 86400.0)]
    assert parse_pairs(format_pairs(pairs, "@")) == pairs


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"fates": [{"sender": 1, "receiver": 2, "arrivals": "0@1 x"}]}, "fates.0.arrivals"),
        ({"fates": [{"sender": 1, "arrivals": "0@1"}]}, "`arrivals` need `sender` and `receiver`"),
        ({"fates": [{"sender": 1, "receiver": 2, "count": 3, "arrivals": "0@1"}]}, "exclude all other keys"),
        ({"lateness": {9: "0+1"}}, "lateness names vehicle 9, which is not on the roster"),
        ({"lateness": {1: "0@1"}}, "lateness"),
        ({"datagrams": [{"source": 9, "datagram": "!", "reaches": {1: 1}}]}, "it must be base64"),
        ({"datagrams": [{"source": 9, "datagram": "AA==", "reaches": {7: 1}}]}, "datagrams.0.reaches names vehicle 7"),
        ({"initial_data": "?"}, "it must be base64"),
        ({"expect": {"chains": {1: "abc"}}}, "expect.chains.1"),
    ],
)
def test_invalid_scripted_key_is_refused_with_a_sentence(keys: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ScenarioError) as error:
        parse({"name": "test", "agents": 3, **keys})
    assert sentence in str(error.value)

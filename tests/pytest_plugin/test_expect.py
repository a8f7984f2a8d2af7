"""Test the key `expect` of a scenario."""

from typing import Any, get_args

import pytest

from harness.checker._verdict import CHECKS
from harness.run.simulate import simulate
from harness.scenario.expect import CHARACTERISTIC_NUMBERS, Expect, FigureName
from tests.harness.virtual import scenario


def test_expect_accepts_all_figures_and_characteristics() -> None:
    asked = scenario(agents=2, duration_s=60, network={"channel": {"preset": "wifi_1"}}, final_reconcile=True)
    simulated = simulate(asked, 1)
    assert list(get_args(FigureName)) == list(simulated.result.figures)
    assert CHARACTERISTIC_NUMBERS.keys() == CHECKS.keys()


def test_characteristic_without_expectation_must_not_be_violated() -> None:
    expect = Expect.model_validate({"characteristics": {5: "violated", "6": "not applicable"}})
    verdicts = ("holds", "violated", "not applicable")
    as_expected = {n: [expect.as_expected(str(n), verdict) for verdict in verdicts] for n in (1, 5, 6)}
    assert as_expected == {1: [True, False, True], 5: [False, True, False], 6: [False, False, True]}


@pytest.mark.parametrize(
    ("wanted", "figure", "sentence"),
    [
        (3, 3, None),
        (3, 4, "blocks is 4, and should be 3"),
        ({"min": 3}, 3, None),
        ({"min": 3}, 2, "blocks is 2, and should be at least 3"),
        ({"max": 3}, 3, None),
        ({"max": 3}, 3.5, "blocks is 3.5, and should be at most 3"),
        ({"min": 1, "max": 3}, 0, "blocks is 0, and should be at least 1 and at most 3"),
        ({"min": 0}, None, "blocks is not known, and should be at least 0"),
    ],
)
def test_figures_are_compared_with_their_expectations(wanted: Any, figure: float | None, sentence: str | None) -> None:
    expect = Expect.model_validate({"figures": {"blocks": wanted}})
    assert list(expect.out_of_range({"blocks": figure})) == ([sentence] if sentence else [])


def test_expectations_are_the_same_in_json_and_yaml() -> None:
    one = scenario(expect={"characteristics": {1: "holds"}, "figures": {"blocks": 3}, "seeds": [0, 2]})
    assert type(one).model_validate_json(one.model_dump_json()) == one


def test_expect_accepts_steps_records_and_liveness() -> None:
    expect = Expect.model_validate({"steps": "deviates", "liveness": "not finished"})
    assert expect.as_expected("steps", "deviates")
    assert not expect.as_expected("steps", "as specified")
    assert expect.as_expected("liveness", "not finished")
    assert not expect.as_expected("liveness", "never finishes")
    assert expect.as_expected("records", "not applicable")
    assert not expect.as_expected("records", "contradict")


CHAINS = {10: "abcd", 28: "abcd", 32: "ab", 118: "abx"}


@pytest.mark.parametrize(
    ("wanted", "sentences"),
    [
        ({"common": [{"agents": [32], "blocks": {"max": 2}}]}, []),
        (
            {"common": [{"agents": [32], "blocks": {"max": 1}}]},
            ["the chain of agent 32 has 2 blocks, and should have at most 1"],
        ),
        ({"common": [{"agents": [10, 28, 118], "blocks": 2}]}, []),
        (
            {"common": [{"agents": [10, 28, 118], "blocks": {"min": 3}}]},
            ["the common chain of agents 10 28 118 has 2 blocks, and should have at least 3"],
        ),
        (
            {"common": [{"agents": [10, 7], "blocks": 1}]},
            ["the common chain of agents 10 7 is not known, and should have 1"],
        ),
    ],
)
def test_chains_are_compared_with_their_expectations(wanted: dict[str, Any], sentences: list[str]) -> None:
    assert list(Expect.model_validate(wanted).unexpected_common_blocks(CHAINS)) == sentences


def test_expect_accepts_deviating_agents_with_their_handlers() -> None:
    expect = Expect.model_validate({"deviations": {32: "reconcile_phase_3"}})
    assert expect.as_expected("steps", "deviates") and not expect.as_expected("steps", "as specified")
    assert list(expect.unexpected_deviations([(32, "reconcile_phase_3"), (32, "reconcile_phase_2")])) == []
    assert list(expect.unexpected_deviations([(32, "reconcile_phase_2"), (10, None)])) == [
        "agent 10 deviates first in no known handler, and should not",
        "agent 32 deviates first in reconcile_phase_2, and should in reconcile_phase_3",
    ]
    assert list(expect.unexpected_deviations([])) == ["agent 32 does not deviate, and should in reconcile_phase_3"]
    with pytest.raises(ValueError, match="the nearest are reconcile_phase_3"):
        Expect.model_validate({"deviations": {32: "reconcile_phase_33"}})

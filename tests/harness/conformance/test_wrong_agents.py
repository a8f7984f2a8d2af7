"""Check the table in docs/appendix/wrong-agents-conformance.md."""

import re
from random import Random

import pytest

from docs.generate.wrong_agents.conformance_page import ALIKE, PAGE
from docs.generate.wrong_agents.trials_page import rows_of
from harness.conformance._alphabet import INPUTS, LOG, TIMER
from harness.conformance._reference_model import AGENT, INITIAL_DATA, ROSTER, ReferenceModel
from harness.conformance._state_space import STEP_S, VARIANTS
from ucp.agent import Agent
from ucp.quirks import QUIRKS, wrong_handlers

WAY = (LOG, "vote no", "vote no", TIMER, LOG, "vote yes", "vote no", LOG, TIMER, LOG, "vote no", TIMER, TIMER)


def test_table_has_a_failure_of_every_wrong_agent() -> None:
    rows = rows_of(PAGE.read_text(encoding="utf-8"))
    assert rows.keys() == QUIRKS.keys()
    assert not [quirk for quirk, row in rows.items() if int(row.split("|")[5]) == 0]


def test_table_names_the_right_algorithm_first_for_most_agents() -> None:
    rows = rows_of(PAGE.read_text(encoding="utf-8"))
    named = {quirk: re.findall(r"\d+|program", row.split("|")[4])[0] for quirk, row in rows.items()}
    wrongly = {quirk for quirk, first in named.items() if first not in map(str, QUIRKS[quirk].algorithms)}
    assert len(wrongly) <= 3 and ALIKE.keys() <= wrongly, wrongly


@pytest.mark.parametrize(("quirk", "other"), ALIKE.items())
def test_quirks_in_alike_have_the_same_effect_outside_the_agent(quirk: str, other: str) -> None:
    settings = VARIANTS["default"].settings
    right, wrong = ReferenceModel(settings), [ReferenceModel(settings), ReferenceModel(settings)]
    for model, name in zip(wrong, (quirk, other), strict=True):
        model.agent = Agent(AGENT, ROSTER, INITIAL_DATA, settings, handlers=wrong_handlers({name: True}, Random(0)))
    now, said = 0.0, 0
    for name in WAY:
        action = INPUTS[name].make(right)
        if action is None:
            continue
        deadlines = {model.agent.next_timer() for model in wrong}
        assert len(deadlines) == 1
        ends = max(filter(None, (*deadlines, right.agent.next_timer())), default=now)
        now = ends if name == TIMER else now + STEP_S
        right.feed(action, now, round(now * 1e6))
        first, second = (
            (model.feed(action, now, round(now * 1e6)), model.datagrams, model.status(), model.handled)[1:3]
            for model in wrong
        )
        assert first[0] == second[0]
        assert {**first[1], "handled": 0} == {**second[1], "handled": 0}
        said += len(first[0])
    assert said > 3

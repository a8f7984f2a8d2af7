"""The generated vectors: the same at each call, all branches in them, and the agent in virtual time answers so."""

import json
from collections import Counter

import pytest

from harness.conformance.vectors import Vectors, generate, to_lines
from ucp.agent import HANDLERS
from ucp.virtual import InputError, VirtualAgent


@pytest.fixture(scope="module")
def generated() -> list[Vectors]:
    return generate()


def test_every_branch_is_in_a_vector_but_one_that_needs_small_events(generated: list[Vectors]) -> None:
    taken = {
        (run.handler, run.branch)
        for vectors in generated
        for step in vectors.wanted.values()
        for run in step.outcome.runs
    }
    declared = {(handler.name, branch) for handler in HANDLERS.values() for branch in handler.branches}
    assert declared - taken == {("build_data_block", "building")}


def test_of_other_settings_only_what_differs_is_a_vector(generated: list[Vectors]) -> None:
    counts = {vectors.variant.name: len(vectors.wanted) for vectors in generated}
    assert counts["default"] > 5000
    assert all(0 < count < counts["default"] / 2 for name, count in counts.items() if name != "default")


def test_the_file_is_the_same_each_time_and_says_what_an_agent_in_virtual_time_answers() -> None:
    lines = list(to_lines(generate("receive_request_next_in_sequence")))
    assert lines == list(to_lines(generate("13")))
    header, *steps = map(json.loads, lines)
    by_number = {step["step"]: step for step in steps}
    vectors = [step for step in steps if step.get("vector")]
    assert header["vectors"] == len(vectors) > 100
    for vector in vectors[::7]:
        way = [vector]
        while way[0]["after"] is not None:
            way.insert(0, by_number[way[0]["after"]])
        agent = VirtualAgent(way[0]["in"])
        for step in way[1:]:
            agent.give(step["in"])
            answer = json.loads(agent.answer())
            assert answer["sent"] == step["out"]["sent"], step
            assert answer["timer"] == step["out"]["timer"], step


def test_a_mission_of_the_vectors_is_one_that_an_agent_takes(generated: list[Vectors]) -> None:
    roots = [step["in"] for step in map(json.loads, to_lines(generated[3:5])) if step.get("after", 0) is None]
    assert [root["mission"]["features"] for root in roots] == [["vote_names_chain"], ["changed_before_tally"]]
    for root in roots:
        try:
            VirtualAgent(root)
        except InputError as error:
            pytest.fail(str(error))


def test_no_pair_is_there_twice(generated: list[Vectors]) -> None:
    for vectors in generated:
        assert Counter(step.pair for step in vectors.steps).most_common(1)[0][1] == 1

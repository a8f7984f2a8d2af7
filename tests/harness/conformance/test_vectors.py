"""Test the generated test vectors: they are always the same, cover all branches, and agree with the agent in virtual
time.
"""

import json
from collections import Counter

import pytest

from harness.conformance.vectors import VectorSet, generate, to_lines
from ucp.agent import HANDLERS
from ucp.virtual import InputError, VirtualAgent


@pytest.fixture(scope="module")
def generated() -> list[VectorSet]:
    return generate()


def test_vectors_cover_every_branch_except_one_of_small_events(generated: list[VectorSet]) -> None:
    taken = {
        (run.handler, run.branch)
        for vectors in generated
        for step in vectors.wanted.values()
        for run in step.outcome.runs
    }
    declared = {(handler.name, branch) for handler in HANDLERS.values() for branch in handler.branches}
    assert declared - taken == {("build_data_block", "building")}


def test_other_settings_add_only_vectors_that_differ(generated: list[VectorSet]) -> None:
    counts = {vectors.variant.name: len(vectors.wanted) for vectors in generated}
    assert counts["default"] > 5000
    assert all(0 < count < counts["default"] / 2 for name, count in counts.items() if name != "default")


def test_file_of_vectors_agrees_with_the_agent_in_virtual_time() -> None:
    lines = list(to_lines(generate("receive_request_next_in_sequence")))
    assert lines == list(to_lines(generate("13")))
    header, *steps = map(json.loads, lines)
    by_number = {step["step"]: step for step in steps}
    vectors = [step for step in steps if step.get("vector")]
    assert header["vectors"] == len(vectors) > 100
    for vector in vectors[::7]:
        path = [vector]
        while path[0]["after"] is not None:
            path.insert(0, by_number[path[0]["after"]])
        agent = VirtualAgent(path[0]["in"])
        for step in path[1:]:
            agent.give(step["in"])
            answer = json.loads(agent.answer())
            assert answer["sent"] == step["out"]["sent"], step
            assert answer["timer"] == step["out"]["timer"], step


def test_agent_accepts_the_missions_of_the_vectors(generated: list[VectorSet]) -> None:
    roots = [step["in"] for step in map(json.loads, to_lines(generated[3:5])) if step.get("after", 0) is None]
    assert [root["mission"]["features"] for root in roots] == [["vote_names_chain"], ["changed_before_tally"]]
    for root in roots:
        try:
            VirtualAgent(root)
        except InputError as error:
            pytest.fail(str(error))


def test_no_vector_appears_twice(generated: list[VectorSet]) -> None:
    for vectors in generated:
        assert Counter(step.key for step in vectors.steps).most_common(1)[0][1] == 1

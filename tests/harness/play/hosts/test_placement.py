"""Test how the harness distributes agents over workers."""

import pytest

from harness.play.hosts._placement import place


@pytest.mark.parametrize(
    ("agents", "threads", "sizes"),
    [(6, {"a": 1, "b": 2}, [2, 4]), (200, dict.fromkeys("abcd", 3), [50] * 4), (5, dict.fromkeys("abc", 1), [2, 1, 2])],
)
def test_workers_get_agents_in_proportion_to_threads(agents: int, threads: dict[str, int], sizes: list[int]) -> None:
    placed = place(range(1, agents + 1), threads)
    assert [len(each) for each in placed.values()] == sizes
    assert [agent for each in placed.values() for agent in each] == [*range(1, agents + 1)]


def test_worker_without_an_agent_is_left_out() -> None:
    assert place([7], {"a": 1, "b": 9}) == {"b": [7]}

"""Distribute agents over workers in proportion to the threads of the workers."""

from collections.abc import Mapping, Sequence


def place(agents: Sequence[int], threads: Mapping[str, int]) -> dict[str, list[int]]:
    """Return the agents of each worker. `threads` contains the number of threads of each worker, by the worker's
    address. The agents of a worker have consecutive positions in the roster. Workers without agents are omitted.
    """
    workers, total = sorted(threads), sum(threads.values())
    placed, before = dict[str, list[int]](), 0
    for worker in workers:
        after = before + threads[worker]
        first, end = (round(len(agents) * count / total) for count in (before, after))
        if first < end:
            placed[worker] = [*agents[first:end]]
        before = after
    return placed

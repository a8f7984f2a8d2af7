"""The order of all blocks of a mission, in which every chain can be read.

First comes the mutual chain, as all agents have it. After it a block comes later than the blocks below it in every
chain, as long as the chains agree; among those that may come next, the one with the earliest timestamp does, then that
of the lowest agent ID. Where chains contradict each other, so that blocks would have to come before themselves, these
blocks stand together in order of time. The same exports give the same order.
"""

from collections.abc import Iterable, Mapping, Sequence
from heapq import heapify, heappop, heappush
from itertools import pairwise

from harness.archive.exports import ExportedBlock


def mutual_chain(chains: Iterable[Sequence[str]]) -> Sequence[str]:
    """What all chains begin with."""
    first, *others = chains
    length = len(first)
    for other in others:
        length = min(length, len(other))
        if first[:length] != other[:length]:
            length = next(place for place in range(length) if first[place] != other[place])
    return first[:length]


def ordered(blocks: Mapping[str, ExportedBlock], chains: Sequence[Sequence[str]]) -> list[str]:
    """The hashes of `blocks`, which are all that the chains hold, and perhaps others. There is a chain at least."""
    mutual = mutual_chain(chains)
    first = set(mutual)
    after: dict[str, set[str]] = {block_hash: set() for block_hash in blocks if block_hash not in first}
    tails = [chain[len(mutual) :] for chain in dict.fromkeys(map(tuple, chains))]
    for tail in tails:
        for below, above in pairwise(tail):
            if below != above and below in after and above in after:
                after[below].add(above)
    apart = sum(map(len, tails)) == len(set().union(*tails))  # then no two of them can contradict each other
    component = {block_hash: number for number, block_hash in enumerate(after)} if apart else _components(after)
    members: dict[int, list[str]] = {}
    for block_hash, number in component.items():
        members.setdefault(number, []).append(block_hash)

    def age(block_hash: str) -> tuple[int, int, str]:
        return blocks[block_hash].timestamp_us, blocks[block_hash].agent_id, block_hash

    waits_for = dict.fromkeys(members, 0)
    leads_to: dict[int, set[int]] = {number: set() for number in members}
    for below, above in ((below, each) for below, others in after.items() for each in others):
        if component[below] != component[above] and component[above] not in leads_to[component[below]]:
            leads_to[component[below]].add(component[above])
            waits_for[component[above]] += 1
    for together in members.values():
        together.sort(key=age)
    free = [(age(members[number][0]), number) for number, count in waits_for.items() if not count]
    heapify(free)
    order = list(dict.fromkeys(mutual))
    while free:
        _, number = heappop(free)
        order += members[number]
        for later in leads_to[number]:
            waits_for[later] -= 1
            if not waits_for[later]:
                heappush(free, (age(members[later][0]), later))
    return order


def _components(after: Mapping[str, set[str]]) -> dict[str, int]:
    """The strongly connected component that each is in (Tarjan, 1972), without recursion, for chains are long."""
    index: dict[str, int] = {}
    lowest: dict[str, int] = {}
    component: dict[str, int] = {}
    stack: list[str] = []
    for root in after:
        if root in index:
            continue
        index[root] = lowest[root] = len(index)
        stack.append(root)
        path = [(root, iter(after[root]))]
        while path:
            block, others = path[-1]
            other = next(others, None)
            if other is None:
                path.pop()
                if path:
                    below = path[-1][0]
                    lowest[below] = min(lowest[below], lowest[block])
                if lowest[block] == index[block]:
                    number = index[block]
                    while True:
                        member = stack.pop()
                        component[member] = number
                        if member == block:
                            break
            elif other not in index:
                index[other] = lowest[other] = len(index)
                stack.append(other)
                path.append((other, iter(after[other])))
            elif other not in component:
                lowest[block] = min(lowest[block], index[other])
    return component

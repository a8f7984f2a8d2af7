"""Create a swarm for explorations that begin with idle agents and diverged chains."""

from collections.abc import Sequence

from harness.proof.bounds import Bounds
from harness.proof.model._global_states import AGENTS, ModelSwarm
from harness.proof.model._zones import NOTHING_RUNS


def forked(bounds: Bounds, holders: Sequence[int]) -> ModelSwarm:
    """Return a swarm whose initial state has several chains of one block each.

    `holders` has the number of agents that hold each chain. The other agents hold no block. The agents could not reach
    each other until now. The blocks of these chains are the first blocks of `bounds.blocks`.
    """
    swarm = ModelSwarm(bounds)
    agents = list(swarm.initial[AGENTS:])
    maker = 0
    for ordinal, count in enumerate(holders, 1):
        voting = swarm.local.complete(agents[maker], ordinal)
        ((timer, _),) = voting.started
        committed = swarm.local.end_timer(voting.local, timer)
        (commit,) = committed.sent
        agents[maker] = committed.local
        for follower in range(maker + 1, maker + count):
            heard = swarm.local.hear(agents[follower], swarm.name_of(maker, follower), commit)
            agents[follower] = heard.local
        maker += count
    swarm.initial = (len(holders), 0, NOTHING_RUNS, *agents)
    return swarm

"""Seeds drawn from a run's seed: one for every agent, so that all backends give it the same events."""

from random import Random


def agent_seed(seed: int, agent_id: int, life: int = 1) -> int:
    """What an agent's events and quirks are drawn from; an agent that was restarted is in its second `life`."""
    again = f" life {life}" if life > 1 else ""
    return Random(f"{seed}/agent {agent_id}{again}").getrandbits(63)

"""Run agents with keys without a network. The test delivers the datagrams of each agent to the other agents."""

from ucp.events import LoggableEvent
from ucp.secure.bundle import Bundle, KeySet
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session

ROSTER = (1, 2, 3)
KEYS = KeySet.derived(bytes(32), ROSTER)
FULL = bytes(256)
"""Data of an event. Four such events fill a block."""


def session(agent_id: int, keys: KeySet = KEYS, started_us: int = 1) -> Session:
    return Session(keys.bundle(agent_id), make_boot(started_us, bytes(8)))


def agent(agent_id: int, keys: KeySet = KEYS, started_us: int = 1) -> SecuredAgent:
    return SecuredAgent(session(agent_id, keys, started_us), agent_id, ROSTER, b"test")


def complete_a_block(agent: SecuredAgent, now: float = 0.0) -> list[bytes]:
    """Log events until the agent proposes a block, and return its datagrams."""
    while not agent.state.blocks_to_be_committed:
        agent.add_event(LoggableEvent(round(now * 1e6), 7, FULL), now)
    return agent.datagrams_to_send()


def secrets_of(bundle: Bundle) -> list[bytes]:
    return [bundle.private_key, bundle.group_secret]

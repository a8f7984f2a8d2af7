"""Fuzz target: the stored data of an agent. An input that begins with a brace gets correct checksums.

The agent refuses the stored data in one sentence, or boots from the stored state. In the second case, the state is the
same after it is written and read again.
"""

import zlib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz.finding import require, sound
from ucp.agent import Agent
from ucp.events import LoggableEvent
from ucp.messages import decode
from ucp.store import Store, StoredState, StoreError
from ucp.trace import HandlerRun

ROSTER = (1, 2, 3)


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / "1.store"
        path.write_bytes(_checked(data) if data.startswith(b"{") else data)
        agent = _agent()
        try:
            store = Store(path, agent.state)
        except StoreError as error:
            sound(str(error))
            return
        if store.recovered is None:
            require(not data, "a file that is no store is not refused")
            return
        agent.boot(store.recovered, 5.0)
        _write(store, agent)
        for datagram in agent.datagrams_to_send():
            decode(datagram)
        agent.add_event(LoggableEvent(5, 1, b"after"), 5.0)
        _write(store, agent)
        store.close()
        again = Store(path, _agent().state)
        require(again.recovered in (store.recovered, StoredState.of(agent.state)), "a store is read otherwise")


def _write(store: Store, agent: Agent) -> None:
    store.write([change for run in agent.trace() if isinstance(run, HandlerRun) for change in run.changes])
    require(store.problem is None, f"the store cannot be written: {store.problem}")


def _checked(data: bytes) -> bytes:
    return b"".join(b"%08x %s\n" % (zlib.crc32(line), line) for line in data.split(b"\n"))


def _agent() -> Agent:
    return Agent(1, ROSTER, b"fuzz")


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield a store with blocks in the chain and in all other lists, with and without its checksums."""
    with TemporaryDirectory() as directory:
        path = Path(directory) / "1.store"
        agent = _agent()
        store = Store(path, agent.state)
        for second in range(12):
            agent.add_event(LoggableEvent(second, 1, bytes(250)), float(second))
            _write(store, agent)
            if second in (5, 10):
                agent.handle_timer(float(second) + 20)
                _write(store, agent)
        agent.begin_reconcile(40.0)
        agent.handle_timer(60.0)
        _write(store, agent)
        store.close()
        content = path.read_bytes()
    yield content
    yield b"\n".join(line.partition(b" ")[2] for line in content.splitlines())

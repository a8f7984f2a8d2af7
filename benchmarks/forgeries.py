"""Send forged, repeated and otherwise invalid datagrams to secured agents: `python -m benchmarks.forgeries [--each
1000000]`.

An agent with keys first receives messages of other agents, and then `--each` forged datagrams of each class. The table
has a row for each class. A row has the number of accepted datagrams, whether the state of the agent changed, and the
processor time for one datagram. It also gives this time as a multiple of the time for a datagram with a wrong tag. The
time to make the datagrams does not count. `--only CLASS ...` selects classes. In each mission second, 40,000 datagrams
arrive. The budgets for wrong signatures and unknown incarnations therefore refill slowly.

`--replays RUNS` plays simulated missions in which all agents receive each datagram again later. `--nonces RUNS` plays
simulated missions with reboots, with and without their disk, and counts repeated pairs of key and nonce.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import cycle, islice
from random import Random
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from harness.play.simulation.air import StrayDatagram, VirtualAir
from harness.run.simulate import MemoryRecorder, simulate, simulate_in_memory
from harness.scenario import Scenario
from ucp.block import Block
from ucp.messages import BlockAddRequest, BlockResponse, ChainContainResponse, CommitBlock, Message, encode
from ucp.secure.bundle import KeySet
from ucp.secure.crypto_suite import SenderKeys
from ucp.secure.envelope import CLEAR, SIGNATURE_BYTES, ClearHeader
from ucp.secure.revocation import Revocation
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session
from ucp.trace import RecordedBytes

ROSTER = (1, 2, 3)
KEYS = KeySet.derived(b"forgeries".ljust(32, b"\0"), ROSTER)
OTHERS = KeySet.derived(b"another mission".ljust(32, b"\0"), ROSTER)
EPOCH = 5
NOW = EPOCH * KEYS.public.epoch_s
POOL = 512
"""Number of authentic datagrams from which a class makes its forgeries, if each takes long to make."""
AT_ONCE = 2000
PER_S = 40_000
"""Number of forged datagrams that arrive per mission second."""
RUNS_AT_ONCE = 500
LATER_S = (1.0, 40.0)


def session(agent_id: int, keys: KeySet = KEYS, now: float = NOW) -> Session:
    begun = Session(keys.bundle(agent_id), make_boot(1_000_000, bytes(8)))
    begun.set_clock(0.0)
    begun.set_clock(now)
    return begun


def listener() -> SecuredAgent:
    """Return agent 1, which has received one datagram from each other agent, and a challenge that agent 2 sent to agent
    3.
    """
    agent = SecuredAgent(session(1), 1, ROSTER, b"test", tracing=False)
    for other in ROSTER[1:]:
        agent.receive_datagram(session(other).seal(0, messages(Random(0))[0], None, None, 0), NOW)
    agent.receive_datagram(challenge_to_another(), NOW)
    agent.datagrams_to_send()
    return agent


def challenge_to_another() -> bytes:
    """Return a challenge of agent 2 to agent 3."""
    two = session(2)
    two.challenges.ask(3, NOW)
    (challenge,) = two.control_datagrams(0, NOW)
    return challenge


def messages(draw: Random) -> list[Message]:
    """Return a message of each type. Types with several forms have a message of each form."""
    a, b = draw.randbytes(32), draw.randbytes(32)
    block = Block(2, draw.randrange(2**40), draw.randbytes(draw.randrange(1, 300)))
    return [BlockAddRequest(a, b), CommitBlock(block, a), ChainContainResponse(a, True), BlockResponse(block)]


def pool(maker: Session, draw: Random, first: int = 1) -> list[bytes]:
    """Return authentic datagrams that no agent has received yet."""
    made = []
    while len(made) < POOL:
        for message in messages(draw):
            signature = draw.randbytes(SIGNATURE_BYTES)
            made.append(maker.seal(first + len(made), message, None, signature, 0))
    return made


# The classes: each generator is endless


def at_random(draw: Random) -> Iterator[bytes]:
    while True:
        noise = draw.randbytes(draw.randrange(200))
        yield noise
        yield b"UC\3" + noise
        yield _header(draw, len(noise)) + noise


def _header(draw: Random, length: int) -> bytes:
    numbers = draw.randrange(1, 11), draw.choice(ROSTER), draw.randrange(2**32), length, EPOCH
    return CLEAR.pack(b"UC", 3, *numbers, make_boot(1_000_000, bytes(8)), 0)


def bits_flipped(draw: Random) -> Iterator[bytes]:
    for good in cycle(pool(session(2), draw)):
        forged = bytearray(good)
        for _ in range(draw.choice((1, 1, 2, 3, 8))):
            forged[draw.randrange(len(forged))] ^= 1 << draw.randrange(8)
        if forged != good:
            yield bytes(forged)


def truncated(draw: Random) -> Iterator[bytes]:
    for good in cycle(pool(session(2), draw)):
        short = good[: draw.randrange(len(good))]
        yield short
        if len(short) >= CLEAR.size:
            yield short[:12] + (len(short) - CLEAR.size).to_bytes(2, "big") + short[14:]


def another_sender(draw: Random) -> Iterator[bytes]:
    for good in cycle(pool(session(2), draw)):
        yield good[:4] + (3).to_bytes(4, "big") + good[8:]
        yield good[:4] + draw.randbytes(4) + good[8:]


def another_mission(draw: Random) -> Iterator[bytes]:
    yield from cycle(pool(session(2, OTHERS), draw))


def an_old_epoch(draw: Random) -> Iterator[bytes]:
    old = pool(session(2, now=NOW - 2 * KEYS.public.epoch_s), draw)
    for datagram in cycle(old):
        yield datagram
        yield datagram[:14] + (EPOCH - draw.randrange(2)).to_bytes(4, "big") + datagram[18:]


def unsigned(draw: Random) -> Iterator[bytes]:
    sealed = pool(session(2), draw)
    for number, good in enumerate(cycle(sealed)):
        yield encode(2, number, messages(draw)[number % 4])
        yield good[:-SIGNATURE_BYTES] + bytes(SIGNATURE_BYTES)
        yield good[:12] + (len(good) - CLEAR.size - SIGNATURE_BYTES).to_bytes(2, "big") + good[14:-SIGNATURE_BYTES]


def wrong_private_key(draw: Random) -> Iterator[bytes]:
    imposter = session(3)
    imposter.agent_id = 2
    yield from cycle(pool(imposter, draw))


def parts_swapped(draw: Random) -> Iterator[bytes]:
    heard = pool(session(2), draw) + pool(session(3), draw)
    while True:
        one, two, three = draw.sample(heard, 3)
        yield one[: CLEAR.size] + two[CLEAR.size : -SIGNATURE_BYTES] + three[-SIGNATURE_BYTES:]
        body = two[CLEAR.size :]
        yield one[:12] + len(body).to_bytes(2, "big") + one[14 : CLEAR.size] + body
        yield one[:-SIGNATURE_BYTES] + two[-SIGNATURE_BYTES:]


def lengths_that_lie(draw: Random) -> Iterator[bytes]:
    for good in cycle(pool(session(2), draw)):
        right, lie = good[12:14], draw.randbytes(2)
        if lie != right:
            yield good[:12] + lie + good[14:]
        yield good + draw.randbytes(draw.randrange(1, 100))


def forged_revocations(draw: Random) -> Iterator[bytes]:
    """Yield revocations that an attacker without keys has signed. Each has a number that no agent knows."""
    body = Revocation.signed(Ed25519PrivateKey.generate(), KEYS.public.mission, 7, [1]).encode()
    for number in cycle(range(8, 2**16)):
        signed = number.to_bytes(2, "big") + body[2:]
        yield ClearHeader(10, 2, 0, EPOCH, make_boot(1_000_000, bytes(8)), number).pack(len(signed)) + signed


def revocations_of_an_insider(draw: Random) -> Iterator[bytes]:
    insider = session(2)
    yield from cycle(insider.seal_revocation(draw.randbytes(2) + b"\0\1" + draw.randbytes(68), 7) for _ in range(POOL))


def far_epochs(draw: Random) -> Iterator[bytes]:
    for good in cycle(pool(session(2), draw)):
        yield good[:14] + (EPOCH + 2 + draw.randrange(4000)).to_bytes(4, "big") + good[18:]


def recorded_challenges(draw: Random) -> Iterator[bytes]:
    """Yield, again and again, the challenge that the listener has received."""
    yield from cycle([challenge_to_another()])


def unknown_boots(draw: Random) -> Iterator[bytes]:
    for good in cycle(pool(session(2), draw)):
        yield good[: CLEAR.size - 18] + make_boot(2_000_000, draw.randbytes(8)) + good[CLEAR.size - 2 :]


CLASSES: dict[str, Callable[[Random], Iterator[bytes]]] = {
    made.__name__: made
    for made in (
        *(at_random, bits_flipped, truncated, another_sender, another_mission),
        *(an_old_epoch, unsigned, wrong_private_key, parts_swapped, lengths_that_lie),
        *(forged_revocations, revocations_of_an_insider, far_epochs, unknown_boots, recorded_challenges),
    )
}


def all_of(agent: SecuredAgent) -> dict[str, Any]:
    """Return all parts of the agent's state that a datagram might change."""
    state, session = agent.state, agent.session
    return {
        "received": agent.received.copy(),
        "chain": (len(state.chain), state.chain.top_chain_hash, len(state.blocks_to_be_committed)),
        "reconcile": (state.reconcile_in_progress, len(state.reconcile_stack), state.vote_count.copy()),
        "timers": [timer.deadline for timer in state.timers],
        "epoch": session.epochs.current,
        "keys": len({(sender, boot) for _, sender, boot in session.epochs._sender_keys}),
        "signatures": dict(agent.signatures),
        "revoked": agent.revoked,
        "heard": {
            sender: (life.boot, life.window._newest, tuple(life.window._words), dict(life.requests))
            for sender, life in session._incarnations.items()
        },
    }


def forge(
    make: Callable[[Random], Iterator[bytes]], count: int, seed: int = 1
) -> tuple[int, bool, float, Counter[str]]:
    """Send forged datagrams to an agent. Return the number of accepted datagrams, whether the state of the agent
    changed, the processor seconds, and the number of dropped datagrams by reason.
    """
    agent, forgeries = listener(), make(Random(1))
    before, seconds, answered, now = all_of(agent), 0.0, 0, NOW
    for _ in range(-(-count // AT_ONCE)):
        few = list(islice(forgeries, min(AT_ONCE, count)))
        began = time.process_time()
        for datagram in few:
            agent.receive_datagram(datagram, now)
            now += 1 / PER_S
        seconds += time.process_time() - began
        answered += len(agent.datagrams_to_send())
    return (
        answered + agent.received.total() - before["received"].total(),
        all_of(agent) != before,
        seconds,
        agent.dropped,
    )


def flying(duration_s: float, **more: Any) -> Scenario:
    fresh = {"keys": "fresh"}
    return Scenario.model_validate({"name": "flying", "security": fresh, "duration_s": duration_s, **more})


class ReplayingAir(VirtualAir):
    """A simulated network that delivers each message again to all other agents. LATER_S has the delays of the
    repetitions.
    """

    def broadcast(
        self,
        now: float,
        number: int,
        sequence: int,
        message: Message,
        data_bytes: int,
        datagram: RecordedBytes | None = None,
        sealed: bytes | None = None,
    ) -> None:
        super().broadcast(now, number, sequence, message, data_bytes, datagram, sealed)
        assert sealed is not None, "all is sealed where everything is delivered"
        others = [other for other in range(len(self._roster)) if other != number]
        for later_s in LATER_S:
            self.inject(now + later_s, StrayDatagram(self._roster[number], sealed), others)


def replays(runs: int, loss: float) -> tuple[int, int, list[str]]:
    """Return the number of missions with unchanged chains, the number of datagrams dropped as repeated, and the
    findings.

    With loss, an agent that lost a datagram handles its first repetition, as if the radio were slow. The chains may
    then differ, so the checker judges each step instead.
    """
    same, dropped, bad = 0, 0, list[str]()
    for seed in range(runs):
        request = flying(300, network={"loss": loss}, final_reconcile=True)
        plain = simulate(request, seed, deliver_all=True)
        run = simulate_in_memory(MemoryRecorder(loss > 0), request, seed, deliver_all=True, air=ReplayingAir)
        same += run.result.chains == plain.result.chains
        dropped += sum((agent.dropped or {}).get("replayed", 0) for agent in run.played.agents.values())
        bad += run.result.bad
    return same, dropped, bad


def nonces(seeds: Iterable[int]) -> tuple[int, int]:
    """Return the number of encrypted datagrams, and the number of datagrams that reused a pair of key and nonce."""
    used: set[tuple[int, int]] = set()
    sealed = twice = 0
    sealing = SenderKeys.encrypt

    def taken_down(keys: SenderKeys, sequence: int, body: bytes, clear: bytes) -> bytes:
        nonlocal sealed, twice
        sealed += 1
        nonce = hash((keys._iv, keys._nonce(sequence))), sequence
        twice += nonce in used
        used.add(nonce)
        return sealing(keys, sequence, body, clear)

    SenderKeys.encrypt = taken_down  # type: ignore[method-assign]
    try:
        for seed in seeds:
            used.clear()  # another run has other keys
            lost = {"at_s": 40, "reboot": [1, 2], "down_s": 5, "disk": "lost"}
            kept = {"at_s": 60, "reboot": [2, 3], "down_s": 5, "disk": "kept"}
            again = {"at_s": 80, "reboot": [1], "down_s": 5, "disk": "lost"}
            simulate(flying(120, agents=3, timeline=[lost, kept, again], events={"mean_s": 3}), seed)
    finally:
        SenderKeys.encrypt = sealing  # type: ignore[method-assign]
    return sealed, twice


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--each", type=int, default=1_000_000, help="forgeries of each class")
    parser.add_argument("--only", nargs="+", choices=CLASSES, default=list(CLASSES), help="classes of forgeries")
    parser.add_argument("--nonces", type=int, metavar="RUNS", help="missions in which to count repeated nonces")
    parser.add_argument("--replays", type=int, metavar="RUNS", help="missions in which to repeat all datagrams")
    parser.add_argument("--loss", type=float, default=0.0, help="loss in the missions of --replays")
    arguments = parser.parse_args()
    if arguments.nonces is not None:
        for first in range(0, arguments.nonces, RUNS_AT_ONCE):
            seeds = range(first, min(first + RUNS_AT_ONCE, arguments.nonces))
            sealed, twice = nonces(seeds)
            say(f"{len(seeds)} runs, {sealed} datagrams sealed: a key and nonce came twice {twice} times")
    elif arguments.replays is not None:
        same, dropped, bad = replays(arguments.replays, arguments.loss)
        say(f"{arguments.replays} runs, {dropped} datagrams dropped as replayed, {len(bad)} findings")
        say(f"{same} have the chains of the run without replays")
    else:
        say(f"{'class':26}{'forged':>9}{'accepted':>10}{'changed':>9}{'us each':>9}{'ratio':>7}  why")
        _, _, seconds, why = forge(another_mission, arguments.each)
        wrong_tag_us = seconds / why.total() * 1e6
        for name in arguments.only:
            say(row(name, arguments.each, wrong_tag_us))


def row(name: str, each: int, wrong_tag_us: float) -> str:
    accepted, changed, seconds, why = forge(CLASSES[name], each)
    forged, reasons = why.total(), ", ".join(f"{reason} {count}" for reason, count in why.most_common())
    us = seconds / forged * 1e6
    costs = f"{us:9.1f}{us / wrong_tag_us:7.1f}"
    return f"{name:26}{forged:9}{accepted:10}{'yes' if changed else 'no':>9}{costs}  {reasons}"


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()

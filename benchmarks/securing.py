"""Measure the cost of encryption and signatures: `python -m benchmarks.securing [--rounds 200] [--missions 20]`.

The first table has a row for each type of message. It has the bytes of a plain and of a secured message, and the
processor time to send and to receive each. The second table is about whole missions in virtual time: a sweep, and runs
with traces. Each secured run is compared with the plain run with the same seed.

`--matrix SEEDS` plays the thesis's matrix with this number of seeds instead, like `ucp-harness matrix` on one core. It
also prints two lower limits of the cost. For the first, each datagram is only signed. For the second, it is signed and
verified once. `--speedup 20` plays five agents as processes instead. The exit status is 1 if the processes do not keep
up with the clock.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from tempfile import TemporaryDirectory

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from benchmarks.played_by import LOSS as LOSS_OF_MATRIX
from benchmarks.played_by import scenario as scenario_of_matrix
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.sweep.matrix._cell_play import simulated
from ucp.block import Block
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    datagram_bytes,
    decode,
    encode,
)
from ucp.secure.bundle import KeySet
from ucp.secure.envelope import read_clear_header, sealed_bytes
from ucp.secure.secured_agent import make_boot
from ucp.secure.session import Session

ROSTER = (1, 2)
KEYS = KeySet.derived(bytes(32), ROSTER)
HASH = bytes(32)
BLOCK = Block(2, 1, bytes(800))
MESSAGES: tuple[Message, ...] = (
    BlockAddRequest(HASH, HASH),
    BlockAddResponse(HASH, True),
    CommitBlock(BLOCK, HASH),
    ChainContainQuery(HASH),
    ChainHashSuccessorQuery(HASH),
    NextInSequenceResponse(HASH, HASH, 1),
    BlockResponse(BLOCK),
)
LOSS = (0.0, 0.1, 0.2, 0.3)


def microseconds(rounds: int, what: Callable[[], object]) -> float:
    began = time.process_time()
    for _ in range(rounds):
        what()
    return (time.process_time() - began) / rounds * 1e6


def per_datagram(rounds: int) -> None:
    say("message", "plain bytes", "secured", "sent us", "secured", "opened us", "secured")
    numbers = count()
    sender, receiver = (Session(KEYS.bundle(agent_id), make_boot(1, bytes(8))) for agent_id in (2, 1))

    def seal(message: Message) -> bytes:
        return sender.seal(next(numbers), message, None, None, 0)

    for message in MESSAGES:
        plain, sealed = encode(2, 0, message), [seal(message) for _ in range(rounds)]
        costs = (
            partial(encode, 2, 0, message),
            partial(seal, message),
            partial(decode, plain),
            partial(open_next, receiver, iter(sealed)),
        )
        spent = [f"{microseconds(rounds, cost):.1f}" for cost in costs]
        say(message.NAME, str(datagram_bytes(message)), str(sealed_bytes(message)), *spent)


def open_next(receiver: Session, datagrams: Iterator[bytes]) -> None:
    datagram = next(datagrams)
    receiver.open(datagram, read_clear_header(datagram))


def per_mission(missions: int) -> None:
    say("missions", "plain ms", "secured ms", "ratio", "plain bytes", "secured", "ratio")
    for tracing in (False, True):
        seconds, sent = [0.0, 0.0], [0, 0]
        for loss in LOSS:
            plain = Scenario.model_validate({"name": "cost", "network": {"loss": loss}})
            for seed in range(missions):
                for which, request in enumerate((plain, plain.secured())):
                    began = time.process_time()
                    run = simulate(request, seed, tracing=tracing)
                    seconds[which] += time.process_time() - began
                    sent[which] += sum(agent.bytes_sent or 0 for agent in run.played.agents.values())
        runs = len(LOSS) * missions
        milliseconds = [spent / runs * 1e3 for spent in seconds]
        say(
            "traced" if tracing else "sweep",
            *(f"{spent:.1f}" for spent in milliseconds),
            f"{seconds[1] / seconds[0]:.2f}",
            *(f"{data // runs}" for data in sent),
            f"{sent[1] / sent[0]:.2f}",
        )


def matrix(seeds: int) -> None:
    """Measure the same runs with and without keys, and the lower limits of the cost of keys."""
    plain_s = secured_s = 0.0
    datagrams = 0
    for loss in LOSS_OF_MATRIX:
        cell = scenario_of_matrix(5, loss, final_reconcile=False, settle_s=7200.0)
        keyed = cell.secured()
        for seed in range(1, seeds + 1):
            began = time.process_time()
            simulated(cell, seed)
            between = time.process_time()
            simulated(keyed, seed)
            secured_s += time.process_time() - between
            plain_s += between - began
        datagrams += sum(agent.messages_sent or 0 for agent in simulate(keyed, 1).played.agents.values())
    runs = len(LOSS_OF_MATRIX) * seeds
    plain_ms, secured_ms, each = plain_s / runs * 1e3, secured_s / runs * 1e3, datagrams / len(LOSS_OF_MATRIX)
    key = Ed25519PrivateKey.generate()
    data = bytes(180)
    signature, public = key.sign(data), key.public_key()
    sign_us = microseconds(1000, partial(key.sign, data))
    verify_us = microseconds(1000, partial(public.verify, signature, data))
    say("matrix", "plain ms", "secured ms", "ratio")
    say(f"{runs} runs", f"{plain_ms:.1f}", f"{secured_ms:.1f}", f"{secured_ms / plain_ms:.2f}")
    say("floor", "datagrams", "sign us", "verify us", "signed", "and verified")
    ratios = (1 + each * us / 1e3 / plain_ms for us in (sign_us, sign_us + verify_us))
    say("of a run", f"{each:.0f}", f"{sign_us:.0f}", f"{verify_us:.0f}", *(f"{ratio:.2f}" for ratio in ratios))


def as_processes(speedup: float) -> bool:
    """Return whether five agent processes keep up with the clock, with and without keys.

    The delays of their vote timers show this.
    """
    plain = Scenario.model_validate(
        {"name": "clock", "network": {"loss": 0.15}, "vehicles": {"kind": "none"}, "speedup": speedup}
    )
    kept = True
    say("as processes", "late s", "of s", "processor s", "bad")
    for name, request in (("plain", plain), ("secured", plain.secured())):
        with TemporaryDirectory() as directory:
            began = getrusage(RUSAGE_CHILDREN)
            finished = run(request, 1, Path(directory) / "run", SilentProgress(), "process")
            ended = getrusage(RUSAGE_CHILDREN)
        spent = ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime
        late = finished.timer_lag
        told = (f"{late.late_s:.2f}", f"{late.asked_s:g}") if late else ("?", "?")
        say(name, *told, f"{spent:.1f}", ", ".join(finished.result.bad) or "nothing")
        kept = kept and late is not None and late.tolerable and not finished.result.bad
    return kept


def say(first: str, *cells: str) -> None:
    sys.stdout.write(f"{first:28}" + "".join(f"{cell:>12}" for cell in cells) + "\n")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=1000, help="datagrams of each message")
    parser.add_argument("--missions", type=int, default=20, help="missions at each loss rate")
    parser.add_argument("--matrix", type=int, metavar="SEEDS", help="number of seeds of the matrix")
    parser.add_argument("--speedup", type=float, help="play five agents as processes at this speedup")
    arguments = parser.parse_args()
    if arguments.matrix is not None:
        matrix(arguments.matrix)
    elif arguments.speedup is not None:
        return 0 if as_processes(arguments.speedup) else 1
    else:
        per_datagram(arguments.rounds)
        per_mission(arguments.missions)
    return 0


if __name__ == "__main__":
    sys.exit(main())

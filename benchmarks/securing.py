"""What security costs: `python -m benchmarks.securing [--rounds 200] [--missions 20]`.

Bytes and processor time of each message's datagram, plain and secured, sent and received; then whole missions in
virtual time: a sweep, and runs with traces, each beside the plain one of the same seed.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count

from harness.run.simulate import simulate
from harness.scenario import Scenario
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
from ucp.secure.agent import boot_of
from ucp.secure.bundle import KeySet
from ucp.secure.envelope import read_clear, sealed_bytes
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
    sender, receiver = (Session(KEYS.bundle(agent_id), boot_of(1, bytes(8))) for agent_id in (2, 1))

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
    receiver.open(datagram, read_clear(datagram))


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
                    sent[which] += sum(agent["bytes_sent"] for agent in run.played.agents.values())
        runs = len(LOSS) * missions
        milliseconds = [spent / runs * 1e3 for spent in seconds]
        say(
            "traced" if tracing else "sweep",
            *(f"{spent:.1f}" for spent in milliseconds),
            f"{seconds[1] / seconds[0]:.2f}",
            *(f"{data // runs}" for data in sent),
            f"{sent[1] / sent[0]:.2f}",
        )


def say(first: str, *cells: str) -> None:
    sys.stdout.write(f"{first:28}" + "".join(f"{cell:>12}" for cell in cells) + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=1000)
    parser.add_argument("--missions", type=int, default=20)
    arguments = parser.parse_args()
    per_datagram(arguments.rounds)
    per_mission(arguments.missions)


if __name__ == "__main__":
    main()

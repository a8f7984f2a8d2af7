"""All peers of one agent, as a process on the air: `python -m harness.field.bisection._scripted_peers SCRIPT HEARD
EPOCH_US SPEEDUP`.

SCRIPT has a line for each datagram that they send, `{"t": mission seconds, "datagram": base64}`, in order. A process is
some milliseconds later than the record, the more the longer it reconciles, and that must not change what it hears when:

- what answers a question of the agent's has besides `"after"`, the question's datagram in base64, and `"asked_s"`, when
  it was asked: it waits until the agent asks that, with whatever sequence number;
- all else is as late as the agent's last question was, while it asks: `"question"` in the place of `datagram` says when
  it asks in the record.

HEARD gets a line for each datagram that the agent sends. SIGTERM ends it.
"""

import asyncio
import base64
import json
import math
import signal
import socket
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from netem import addresses
from ucp.clock import MICROSECONDS, MissionClock
from ucp.messages import HEADER, PORT

MAX_READ_BYTES = 65536
DATAGRAMS_PER_TURN = 64


ASKED_EARLY_S = 2.0
"""A question may be so much earlier than in the record, in mission seconds, and still be that one."""


MARGIN_WALL_S = 0.006
"""By how much a timer of a process ends late, about, in wall seconds."""
ASKS_AGAIN_S = 6.0
"""After so many mission seconds without another question the agent no longer reconciles."""


class Lateness:
    """How late the agent is in a reconcile, in mission seconds; `margin_s` is what its next timer adds to that."""

    def __init__(self, margin_s: float) -> None:
        self._margin_s = margin_s
        self._late_s = 0.0
        self._asked_s = -math.inf

    def asks(self, now: float, in_record: Iterable[float]) -> None:
        """The agent asks what it asks in the record at these times."""
        nearest = min(in_record, key=lambda at_s: abs(now - at_s), default=None)
        if nearest is not None and abs(now - nearest) < ASKS_AGAIN_S:
            self._late_s, self._asked_s = max(0.0, now - nearest), nearest

    def at(self, mission_s: float) -> float:
        """How late what comes then in the record should come."""
        return self._late_s + self._margin_s if mission_s - self._asked_s < ASKS_AGAIN_S else 0.0


def what(data: bytes) -> bytes:
    """Type and body of a datagram: the message, whoever sent it with whichever sequence number."""
    return data[3:4] + data[HEADER.size :]


async def play(script: Path, heard: TextIO, clock: MissionClock) -> None:
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ended.set)
    air = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    air.setblocking(False)
    air.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    air.bind(("", PORT))
    lines = [json.loads(line) for line in script.read_text(encoding="utf-8").splitlines()]
    questions: dict[bytes, list[float]] = {}
    for line in lines:
        if "question" in line:
            questions.setdefault(what(base64.b64decode(line["question"])), []).append(line["t"])
    sent: set[bytes] = set()
    asked: dict[bytes, float] = {}
    waiting: dict[bytes, list[bytes]] = {}
    lateness = Lateness(MARGIN_WALL_S * clock.speedup)

    def say(data: bytes) -> None:
        sent.add(data)
        air.sendto(data, (addresses.BROADCAST, PORT))

    def hear() -> None:
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data = air.recv(MAX_READ_BYTES)
            except BlockingIOError:
                return
            if data not in sent:  # the echo of our own
                line = {"t": round(clock.now(), 6), "datagram": base64.b64encode(data).decode("ascii")}
                heard.write(json.dumps(line) + "\n")
                asked[what(data)] = clock.now()
                lateness.asks(clock.now(), questions.get(what(data), ()))
                for answer in waiting.pop(what(data), ()):
                    say(answer)

    loop.add_reader(air, hear)

    async def speak() -> None:
        await asyncio.sleep(max(0.0, (clock.epoch_us or 0) / MICROSECONDS - time.time()))  # it shows 0 until then
        for due in lines:
            if "question" in due:
                continue
            at_s = due["t"] if "after" in due else due["t"] + lateness.at(due["t"])
            await asyncio.sleep(max(0.0, clock.wall_s(at_s - clock.now())))
            data, question = base64.b64decode(due["datagram"]), base64.b64decode(due.get("after", ""))
            if not question or asked.get(what(question), -math.inf) >= due["asked_s"] - ASKED_EARLY_S:
                say(data)
            else:
                waiting.setdefault(what(question), []).append(data)

    speaking = asyncio.create_task(speak())
    await ended.wait()
    speaking.cancel()
    air.close()


def main(arguments: list[str]) -> int:
    script, heard, epoch_us, speedup = arguments
    clock = MissionClock(float(speedup))
    clock.start(int(epoch_us))
    with Path(heard).open("w", encoding="utf-8", buffering=1) as file:
        asyncio.run(play(Path(script), file, clock))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Simulate the peers of one agent: `python -m harness.field.bisection._scripted_peers SCRIPT HEARD EPOCH_US SPEEDUP`.

Each line of SCRIPT is a datagram to send, `{"t": mission seconds, "datagram": base64}`, in order of time. An agent
process reacts some milliseconds later than the recorded agent, and during a reconcile this delay grows. If the peers
sent at the recorded times, a datagram could arrive before a timer of the agent expires, although it arrived after the
expiry in the record. The sending times therefore adapt to the agent:

- The line of a response also contains the query (`"after"`, the datagram in base64) and its recorded time
  (`"asked_s"`). The response waits until the agent sends this query, with any sequence number.

- During a reconcile, all other datagrams are delayed by the delay of the agent's last query. Lines with `"question"`
  instead of `"datagram"` contain the recorded times of the queries.

The program writes a line to HEARD for each datagram that the agent sends. SIGTERM ends the process.
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


MAX_EARLY_S = 2.0
"""Maximum number of mission seconds by which a query may come earlier than in the record."""


MARGIN_WALL_S = 0.006
"""Typical delay of a timer in an agent process, in seconds of wall time."""
MAX_QUESTION_GAP_S = 6.0
"""If an agent sends no query for this number of mission seconds, its reconcile counts as ended."""


class AgentLateness:
    """A measurement of the delay of an agent process during a reconcile. The delay is the number of mission seconds by
    which a query of the process comes later than in the record. `margin_s` is added to the delay, because the next
    timer of the agent may be even later.
    """

    def __init__(self, margin_s: float) -> None:
        self._margin_s = margin_s
        self._late_s = 0.0
        self._asked_s = -math.inf

    def note_question(self, now: float, in_record: Iterable[float]) -> None:
        """Update the measured delay when the agent sends a query. `in_record` contains the times of this query in the
        record.
        """
        nearest = min(in_record, key=lambda at_s: abs(now - at_s), default=None)
        if nearest is not None and abs(now - nearest) < MAX_QUESTION_GAP_S:
            self._late_s, self._asked_s = max(0.0, now - nearest), nearest

    def at(self, mission_s: float) -> float:
        """Return the number of mission seconds by which a datagram must be delayed. `mission_s` is the recorded time of
        the datagram.
        """
        return self._late_s + self._margin_s if mission_s - self._asked_s < MAX_QUESTION_GAP_S else 0.0


def message_key(data: bytes) -> bytes:
    """Return the type and body of a datagram, without its sender and sequence number."""
    return data[3:4] + data[HEADER.size :]


async def play(script: Path, output: TextIO, clock: MissionClock) -> None:
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ended.set)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    sock.bind(("", PORT))
    script_lines = [json.loads(line) for line in script.read_text(encoding="utf-8").splitlines()]
    questions: dict[bytes, list[float]] = {}
    for line in script_lines:
        if "question" in line:
            questions.setdefault(message_key(base64.b64decode(line["question"])), []).append(line["t"])
    own_datagrams: set[bytes] = set()
    last_asked: dict[bytes, float] = {}
    pending_answers: dict[bytes, list[bytes]] = {}
    lateness = AgentLateness(MARGIN_WALL_S * clock.speedup)

    def send(data: bytes) -> None:
        own_datagrams.add(data)
        sock.sendto(data, (addresses.BROADCAST, PORT))

    def receive() -> None:
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data = sock.recv(MAX_READ_BYTES)
            except BlockingIOError:
                return
            if data not in own_datagrams:  # Own broadcasts are received as well.
                line = {"t": round(clock.now(), 6), "datagram": base64.b64encode(data).decode("ascii")}
                output.write(json.dumps(line) + "\n")
                last_asked[message_key(data)] = clock.now()
                lateness.note_question(clock.now(), questions.get(message_key(data), ()))
                for answer in pending_answers.pop(message_key(data), ()):
                    send(answer)

    loop.add_reader(sock, receive)

    async def send_script() -> None:
        # The clock stands at 0 until then.
        await asyncio.sleep(max(0.0, (clock.epoch_us or 0) / MICROSECONDS - time.time()))
        for due in script_lines:
            if "question" in due:
                continue
            at_s = due["t"] if "after" in due else due["t"] + lateness.at(due["t"])
            await asyncio.sleep(max(0.0, clock.wall_s(at_s - clock.now())))
            data, question = base64.b64decode(due["datagram"]), base64.b64decode(due.get("after", ""))
            if not question or last_asked.get(message_key(question), -math.inf) >= due["asked_s"] - MAX_EARLY_S:
                send(data)
            else:
                pending_answers.setdefault(message_key(question), []).append(data)

    sending = asyncio.create_task(send_script())
    await ended.wait()
    sending.cancel()
    sock.close()


def main(arguments: list[str]) -> int:
    script, output, epoch_us, speedup = arguments
    clock = MissionClock(float(speedup))
    clock.start(int(epoch_us))
    with Path(output).open("w", encoding="utf-8", buffering=1) as file:
        asyncio.run(play(Path(script), file, clock))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

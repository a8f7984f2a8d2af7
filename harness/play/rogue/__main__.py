"""Run the rogue node as a process in the virtual network: `python -m harness.play.rogue`.

It receives UCP broadcasts on a UDP socket, and sends complete Ethernet frames (packet(7)) with the MAC and IP addresses
of the agents that it imitates. Its working directory contains `rogue.control`, a socket for the commands `start` and
`inject`, and its journal `rogue.jsonl`. SIGTERM ends it.
"""

import json
import os
import signal
import socket
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from harness.archive.directory import ROGUE_CONTROL, ROGUE_FILE
from harness.play.rogue._journal import RogueJournal
from harness.play.rogue._rogue import RogueLogic
from harness.scenario.injection import MODELS, Lie
from netem.frames import udp_broadcast
from ucp.clock import MissionClock
from ucp.control import CommandError, ControlServer
from ucp.loop import Loop, ScheduledCall
from ucp.messages import PORT

if TYPE_CHECKING:
    from harness.play.rogue._captured_bundle import CapturedKeys

LINK = "eth0"
DATAGRAMS_PER_TURN = 64
MAX_READ_BYTES = 65536


class RogueNode:
    """The process of the rogue node, in the run directory. Raises OSError if a socket or a file cannot be opened."""

    def __init__(self, directory: Path) -> None:
        self._rogue: RogueLogic | None = None
        self._clock = MissionClock(1.0)
        self._timer: ScheduledCall | None = None
        self._loop = Loop()
        self._receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._receiver.setblocking(False)
        self._receiver.bind(("", PORT))
        self._sender = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)  # protocol 0 receives nothing
        self._sender.bind((LINK, 0))
        self._file = (directory / ROGUE_FILE).open("a", encoding="utf-8", buffering=1)
        self._journal = RogueJournal(self._write)
        self._control = ControlServer(
            directory / ROGUE_CONTROL,
            {"start": self._start, "inject": self._inject, "status": self._status},
            self._loop,
        )

    def run(self) -> None:
        """Run until the process receives SIGTERM or SIGINT."""
        self._loop.stop_on(signal.SIGTERM, signal.SIGINT)
        self._loop.watch(self._receiver, readable=self._read_datagrams)
        self._control.start()
        self._loop.run()
        self._journal.close()
        self._file.close()
        self._control.close()
        self._loop.close()

    def _read_datagrams(self) -> None:
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data = self._receiver.recv(MAX_READ_BYTES)
            except BlockingIOError:
                return
            if self._rogue is not None:
                self._rogue.receive(data, self._clock.now())
                self._send()

    def _due(self) -> None:
        assert self._rogue is not None, "a timer runs after the start"
        self._timer = None
        self._rogue.handle_timer(self._clock.now())
        self._send()

    def _send(self) -> None:
        """Send all datagrams that are due. Then set a timer for the next datagrams."""
        assert self._rogue is not None, "no messages to send before the start"
        for injected in self._rogue.to_send():
            now = self._clock.now()
            self._sender.send(udp_broadcast(injected.source, PORT, injected.datagram))
            self._journal.add(injected, now)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        soonest = self._rogue.next_timer()
        if soonest is not None:
            delay_s = self._clock.wall_s(soonest - self._clock.now())
            self._timer = self._loop.call_later(delay_s, self._due)

    def _write(self, record: dict[str, object]) -> None:
        self._file.write(json.dumps(record, separators=(",", ":")) + "\n")

    # Commands of the control socket. Only the harness sends them.

    def _start(self, request: dict[str, Any]) -> dict[str, object]:
        epoch_us = request["epoch_us"]
        self._clock = MissionClock(request["speedup"])
        self._clock.start(epoch_us)
        captured = request.get("captured")
        self._rogue = RogueLogic(
            request["roster"], request["seed"], epoch_us, _load_keys(Path(captured)) if captured else None
        )
        return {}

    def _inject(self, request: dict[str, Any]) -> dict[str, object]:
        if self._rogue is None:
            raise CommandError("the mission has not started")
        try:
            injection = MODELS[request["what"]].model_validate(request["injection"])
        except (KeyError, ValidationError) as error:
            raise CommandError(f"the injection is not valid: {error}") from None
        if isinstance(injection, Lie):
            raise CommandError("a `lie` needs virtual time: use --backend sim")
        self._rogue.begin(request["number"], injection, self._clock.now())
        self._send()
        return {}

    def _status(self, request: dict[str, Any]) -> dict[str, object]:
        return {"sent": dict(self._rogue.sent) if self._rogue is not None else {}}


def _load_keys(path: Path) -> "CapturedKeys":
    from harness.play.rogue._captured_bundle import CapturedKeys  # needs the extra `secure`
    from ucp.secure.bundle import load_bundle

    return CapturedKeys(load_bundle(path), partial(os.urandom, 8))


def main() -> int:
    """Run the rogue node until it is stopped. Return the exit status: 0 after a stop, and 1 if the process has no
    access to the network.
    """
    try:
        RogueNode(Path.cwd()).run()
    except OSError as error:
        sys.stderr.write(f"the rogue node: {error.strerror}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

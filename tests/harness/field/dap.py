"""Control a debugger with the Debug Adapter Protocol, and read the state of the debugged program, like an IDE."""

import json
import socket
import time
from pathlib import Path
from typing import Any

DEADLINE_S = 60.0


class Ide:
    """A client that connects to the debugger at `port`. Raises OSError if no debugger answers in time."""

    def __init__(self, port: int) -> None:
        self._connection = _connect(port)
        self._file = self._connection.makefile("rwb")
        self._sequence = 0
        self._events: list[dict[str, Any]] = []

    def close(self) -> None:
        self._file.close()
        self._connection.close()

    def attach(self, breakpoints: dict[Path, int]) -> None:
        """Connect to the program. In each file, set one breakpoint at the given line."""
        self.ask("initialize", adapterID="test", pathFormat="path", linesStartAt1=True)
        attaching = self._send("attach", {"justMyCode": False})
        self.event("initialized")
        for path, line in breakpoints.items():
            (set_there,) = self.ask("setBreakpoints", source={"path": str(path)}, breakpoints=[{"line": line}])[
                "breakpoints"
            ]
            assert set_there["verified"], set_there
        self.ask("configurationDone")
        self._answer(attaching)

    def stopped_in(self) -> dict[str, Any]:
        """Return the stack frame in which the program has stopped."""
        thread = self.event("stopped")["threadId"]
        frame: dict[str, Any] = self.ask("stackTrace", threadId=thread)["stackFrames"][0]
        return {**frame, "thread": thread}

    def value(self, expression: str, frame: dict[str, Any]) -> str:
        return str(self.ask("evaluate", expression=expression, frameId=frame["id"], context="watch")["result"])

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        return self._answer(self._send(command, arguments))

    def event(self, name: str) -> dict[str, Any]:
        """Return the body of the next event of this name."""
        while True:
            for number, event in enumerate(self._events):
                if event["event"] == name:
                    del self._events[number]
                    body: dict[str, Any] = event.get("body") or {}
                    return body
            self._receive()

    def _send(self, command: str, arguments: dict[str, Any]) -> int:
        self._sequence += 1
        request = {"type": "request", "seq": self._sequence, "command": command, "arguments": arguments}
        content = json.dumps(request).encode()
        self._file.write(b"Content-Length: %d\r\n\r\n%b" % (len(content), content))
        self._file.flush()
        return self._sequence

    def _answer(self, sequence: int) -> dict[str, Any]:
        while True:
            message = self._receive()
            if message["type"] == "response" and message["request_seq"] == sequence:
                assert message["success"], message
                body: dict[str, Any] = message.get("body") or {}
                return body

    def _receive(self) -> dict[str, Any]:
        length = 0
        while (line := self._file.readline()) not in (b"\r\n", b""):
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
        content = self._file.read(length)
        assert content, "the debugger is gone"
        message: dict[str, Any] = json.loads(content)
        if message["type"] == "event":
            self._events.append(message)
        return message


def _connect(port: int) -> socket.socket:
    deadline = time.monotonic() + DEADLINE_S
    while True:
        try:
            connection = socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S)
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)
        else:
            return connection

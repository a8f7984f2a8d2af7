"""Start all agents of a compose file at the same time: `python start.py DIRECTORY`.

The file runs in its own container, so it imports nothing from the project. The mission files in the directory determine
the agents. When the control sockets of all agents exist, the program sends each agent the command `start` (see
ucp/contract/CONTRACT.md).
"""

import json
import os
import socket
import sys
import time
from pathlib import Path

LIMIT_S = 60.0
ASK_AGAIN_S = 0.1
ANSWER_LIMIT_S = 10.0


def main(directory: Path) -> int:
    os.chdir(directory)  # the path of a Unix socket may have at most 107 bytes
    names = [path.name.replace(".mission.json", ".control") for path in sorted(Path().glob("*.mission.json"))]
    deadline = time.monotonic() + LIMIT_S
    while missing := [name for name in names if not Path(name).exists()]:
        if time.monotonic() > deadline:
            sys.stderr.write(f"not started: {', '.join(missing)} missing after {LIMIT_S:g} s\n")
            return 1
        time.sleep(ASK_AGAIN_S)
    epoch_us = time.time_ns() // 1000
    refused = [f"{name}: {answer['error']}" for name in names if not (answer := ask(name, epoch_us))["ok"]]
    for sentence in refused:
        sys.stderr.write(f"{sentence}\n")
    return 1 if refused else 0


def ask(name: str, epoch_us: int) -> dict[str, object]:
    with socket.socket(socket.AF_UNIX) as control:
        control.settimeout(ANSWER_LIMIT_S)
        control.connect(name)
        control.sendall(json.dumps({"command": "start", "epoch_us": epoch_us}).encode() + b"\n")
        answer: dict[str, object] = json.loads(control.makefile().readline())
        return answer


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

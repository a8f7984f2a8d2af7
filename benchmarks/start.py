"""Measure the start time of an agent and its memory: `python -m benchmarks.start HEAD~20 [--rounds 20]`.

Another revision of the project is checked out in a temporary directory. Agents of both revisions start alternately.
Each agent is alone on the loopback interface. Each ratio compares the two agents of one round. An agent is ready when
its control socket answers. The processor time is that of the whole process up to this moment. With `-- COMMAND...` the
benchmark starts another agent in place of the other revision. The agent gets a mission file, which
ucp/contract/CONTRACT.md describes.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from benchmarks.against import ROOT, checked_out
from benchmarks.rounds import Spread, show

_OURS = [sys.executable, "-P", "-m", "ucp.node"]
_LOOK_EVERY_S = 0.0005
_LIMIT_S = 30.0


def _mission() -> dict[str, Any]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return {
        "schema": "ucp-mission/1",
        "agent_id": 7,
        "roster": [7, 9],
        "initial_data": base64.b64encode(b"benchmark").decode("ascii"),
        "network": {"address": "127.0.0.1", "broadcast": "127.255.255.255", "port": port},
        "events": {"source": "random"},
        "settings": {},
        "quirks": {},
        "seed": 1,
        "speedup": 1.0,
        "epoch_us": None,
        "store": None,
    }


def start(command: Sequence[str], root: Path) -> tuple[float, float, float]:
    """Start an agent and wait until it is ready. Return its wall time and processor time in ms, and its memory in
    MB.
    """
    with tempfile.TemporaryDirectory() as directory:
        (Path(directory) / "7.mission.json").write_text(json.dumps(_mission()), encoding="utf-8")
        env = {**os.environ, "PYTHONPATH": str(root)}
        begin = time.perf_counter()
        process = subprocess.Popen([*command, "7.mission.json"], cwd=directory, env=env)
        try:
            _await_answer(process, Path(directory) / "7.control")
            wall_s = time.perf_counter() - begin
            return 1000 * wall_s, 1000 * _processor_s(process.pid), _resident_mb(process.pid)
        finally:
            process.kill()
            process.wait()


def _await_answer(process: subprocess.Popen[bytes], control: Path) -> None:
    deadline = time.monotonic() + _LIMIT_S
    while True:
        with socket.socket(socket.AF_UNIX) as asking:
            try:
                asking.connect(str(control))
                asking.sendall(b'{"command": "status"}\n')
                if asking.recv(65536):
                    return
            except OSError:
                pass
        if process.poll() is not None or time.monotonic() > deadline:
            sys.exit(f"{shlex.join(process.args)} was not ready within {_LIMIT_S:g} s")  # type: ignore[arg-type]
        time.sleep(_LOOK_EVERY_S)


def _processor_s(pid: int) -> float:
    nanoseconds = Path(f"/proc/{pid}/schedstat").read_text().split()[0]
    return int(nanoseconds) / 1e9


def _resident_mb(pid: int) -> float:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(status["VmRSS"].split()[0]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", nargs="?", help="other revision, as git names it")
    parser.add_argument("--rounds", type=int, default=20, help="number of rounds")
    parser.add_argument("--json", action="store_true", help="print JSON")
    before, separator, command = sys.argv[1:], "", []
    if "--" in before:
        place = before.index("--")
        before, separator, command = before[:place], "--", before[place + 1 :]
    arguments = parser.parse_args(before)
    if bool(arguments.revision) == bool(separator):
        parser.error("give a revision, or the command of another agent after --")
    with checked_out(arguments.revision) if arguments.revision else nullcontext(ROOT) as tree:
        other = command or _OURS
        for warm, root in ((other, tree), (_OURS, ROOT)):
            start(warm, root)
        rounds = [(start(other, tree), start(_OURS, ROOT)) for _ in range(arguments.rounds)]
    rows = []
    for place, what in enumerate(("ready, ms", "processor time, ms", "resident, MB")):
        figures = [(theirs[place], ours[place]) for theirs, ours in rounds]
        theirs, ours = ([pair[side] for pair in figures] for side in (0, 1))
        ratio = Spread.of_ratios(ours, theirs)
        rows.append({"what": what, "other": Spread.of(theirs), "this": Spread.of(ours), "ratio": ratio})
    show(rows, {"other": ".1f", "this": ".1f", "ratio": ".2f"}, arguments.json)


if __name__ == "__main__":
    main()

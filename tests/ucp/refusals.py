"""Give an agent the missions and requests of the test vectors `refusals`, and compare its answers."""

import base64
import contextlib
import json
import os
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ucp.contract.vectors import DIRECTORY
from ucp.contract.vectors.replay import Player
from ucp.node import UNSUPPORTED, WRONG_MISSION

DEADLINE_S = 60.0
VECTORS: dict[str, Any] = json.loads((DIRECTORY / "refusals.json").read_text(encoding="ascii"))


def expected(vector: dict[str, Any], features: Sequence[str]) -> str:
    """Return the expected answer of an agent with these features.

    "plays" means that the agent accepts the mission. "lacks" means that it needs a feature which the agent lacks.
    "wrong" means that it is invalid.
    """
    if not {*vector["needs"]} <= {*features}:
        return "lacks"
    return "plays" if vector["plays"] else "wrong"


def wrong_missions(command: list[str], features: Sequence[str]) -> list[tuple[str, Any]]:
    """Give the agent the missions in virtual time. Return each mission that it answers incorrectly, with its answer."""
    differences = []
    with Player(command) as player:
        for vector in VECTORS["missions"]:
            answer = player.give({"t": 0.0, "mission": vector["mission"]})
            came = "lacks" if answer.get("unsupported") else "wrong" if "error" in answer else "plays"
            if came != expected(vector, features):
                differences.append((vector["what"], answer))
    return differences


def wrong_exits(command: list[str], features: Sequence[str], place: Path) -> list[tuple[str, int]]:
    """Give the agent program the mission files. Return each mission for which it has the wrong exit status, with this
    status.
    """
    status = {"lacks": UNSUPPORTED, "wrong": WRONG_MISSION}
    differences = []
    path = place / "7.mission.json"
    for vector in VECTORS["missions"]:
        answer = expected(vector, features)
        if answer == "plays" or "in virtual time" in vector["what"]:
            continue
        path.write_text(json.dumps(vector["mission"]), encoding="ascii")
        ended = subprocess.run(
            [*command, path.name], cwd=place, stderr=subprocess.PIPE, timeout=DEADLINE_S, check=False
        )
        if ended.returncode != status[answer] or not ended.stderr.strip():
            differences.append((vector["what"], ended.returncode))
    return differences


def wrong_answers(command: list[str], place: Path) -> list[tuple[str, Any]]:
    """Give the agent requests on its control socket. Return each request that it answers incorrectly, with its
    answer.
    """
    differences = []
    with _served(command, place) as client, client.makefile("rwb") as stream:
        for vector in VECTORS["requests"]:
            stream.write(base64.b64decode(vector["line"]) + b"\n")
            stream.flush()
            answer = json.loads(stream.readline())
            if {key: answer.get(key) for key in vector["answer"]} != vector["answer"] or (
                answer.get("unsupported") != vector["answer"].get("unsupported")
            ):
                differences.append((vector["what"], answer))
    return differences


@contextlib.contextmanager
def _served(command: list[str], place: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        network = {"address": "127.0.0.1", "broadcast": "127.255.255.255", "port": free.getsockname()[1]}
    mission = {**VECTORS["missions"][0]["mission"], "network": network, "epoch_us": None}
    (place / "7.mission.json").write_text(json.dumps(mission), encoding="ascii")
    with subprocess.Popen([*command, "7.mission.json"], cwd=place) as process:
        try:
            deadline = time.monotonic() + DEADLINE_S
            while not (place / "7.control").exists():
                assert process.poll() is None and time.monotonic() < deadline, "the agent is not ready"
                time.sleep(0.02)
            with socket.socket(socket.AF_UNIX) as client:
                client.settimeout(DEADLINE_S)
                client.connect(os.path.relpath(place / "7.control"))
                yield client
        finally:
            process.terminate()

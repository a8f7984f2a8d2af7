"""Run agents on a worker of a Dask cluster. The functions of this module run on the worker."""

import json
import os
import subprocess
import sys
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from harness.errors import MachineError
from harness.play.agent_control import last_line
from netem import far_network
from netem.errors import LabUnavailable
from sitl.installed import sha256


@dataclass(frozen=True)
class HostOrder:
    """The order to a worker: the agents that the worker runs, and the address at which these agents join the run. For
    an agent without a command, the worker runs the harness's own agent program. `worker` is the address of the worker.
    """

    worker: str
    host: str
    port: int
    secret: str
    """The secret of the run, in hexadecimal digits."""
    commands: dict[int, list[str] | None]


def why_not(programs: list[str], binaries: dict[str, str | None], has_keys: bool) -> str | None:
    """Return a sentence if this computer cannot run agents and vehicles, or if one of their programs is missing.
    Otherwise return None.

    `binaries` contains the SHA-256 hashes of the vehicle programs by their paths. If `has_keys` is true, the harness
    sends keys to the agents, and this computer must be able to decrypt these keys.
    """
    try:
        far_network.needs_user_namespace()
    except LabUnavailable as error:
        return str(error)
    if has_keys and find_spec("cryptography") is None:
        return "this mission has keys, which must travel encrypted: run `pip install 'ucp-harness[secure]'` there"
    missing = [program for program in (*programs, *binaries) if not os.access(program, os.X_OK)]
    if missing:
        return f"it has no program {missing[0]}: install it there at the same path"
    other = [path for path, digest in binaries.items() if sha256(Path(path)) != digest]
    return f"its {other[0]} is another program than here: install the same file on all computers" if other else None


def play_agents(order: HostOrder) -> None:
    """Let agents join a run, and wait until the run has ended. Raises MachineError if the agents could not join.

    The agents run in a separate process, because the main thread of a process must own the private networks. The
    process ends when its standard input ends, so it does not survive this worker.
    """
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH")]))
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "harness.play.hosts.far_host"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": path},
        start_new_session=True,  # Ctrl-C in the terminal of the worker must end the worker first
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        with suppress(BrokenPipeError):  # its output has the reason
            process.stdin.write(json.dumps(vars(order)).encode() + b"\n")
            process.stdin.flush()
        lines = deque(process.stderr, maxlen=1)
        status = process.wait()
    if status != 0:
        raise MachineError(last_line(b"".join(lines).decode(errors="replace")) or f"its agents ended with {status}")

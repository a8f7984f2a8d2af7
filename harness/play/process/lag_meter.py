"""Start and stop a program that measures how late this machine runs programs during a mission."""

import asyncio
import contextlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path

PROGRAM = Path(__file__).with_name("_lag_probe.py")
END_LIMIT_S = 5.0


class LagMeter:
    """A measurement of this machine's delays during a mission. The measurement ends at the latest when this process
    ends.
    """

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    @property
    def pid(self) -> int:
        return self._process.pid

    @classmethod
    async def start(cls, path: Path, epoch_us: int, speedup: float, networks: Mapping[int, int]) -> "LagMeter":
        """Start to measure, and write the results to `path`. `networks` contains the inode number of each agent's
        network namespace.

        Raises OSError if the program cannot be started.
        """
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-I", "-S", str(PROGRAM), str(path)),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C on the terminal must reach only the harness
        )
        assert process.stdin is not None
        agents = {str(inode): str(agent) for agent, inode in networks.items()}
        request = {"epoch_us": epoch_us, "speedup": speedup, "networks": agents}
        process.stdin.write(json.dumps(request).encode() + b"\n")
        return cls(process)

    async def stop(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            await asyncio.wait_for(self._process.wait(), END_LIMIT_S)
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):  # it may end at this moment
                self._process.kill()
            await self._process.wait()

"""Wait in an event loop for a process that was forked without `asyncio.subprocess`."""

import asyncio
import os


class ForkedProcess:
    """A forked process, with the part of the interface of `asyncio.subprocess.Process` that far ends need."""

    def __init__(self, pid: int, descriptor: int) -> None:
        """Create the object. `descriptor` is a file descriptor of the process (pidfd), which the object closes."""
        self.pid = pid
        loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[int] = loop.create_future()
        loop.add_reader(descriptor, self._end, descriptor)

    def _end(self, descriptor: int) -> None:
        asyncio.get_running_loop().remove_reader(descriptor)
        os.close(descriptor)
        try:
            _, status = os.waitpid(self.pid, 0)
        except ChildProcessError:  # another process is the parent
            status = 0
        self._ended.set_result(os.waitstatus_to_exitcode(status))

    @property
    def returncode(self) -> int | None:
        """The exit status, or the negative number of the signal that killed the process. If another process is the
        parent, the exit status is unknown, and the value is 0. The value is None while the process runs.
        """
        return self._ended.result() if self._ended.done() else None

    async def wait(self) -> int:
        return await asyncio.shield(self._ended)

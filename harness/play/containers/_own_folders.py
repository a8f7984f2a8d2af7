"""Give each agent in a container its own folder, so that the agent can neither read nor change files of other agents.

All agents of a run have their files in one directory, `agents/`. In the container of agent 7, Docker mounts
`agents/7-1/` at the path of `agents/`. During the run, links in `agents/` point to the files of the agents. At the end,
the files replace the links.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from docker.types import Mount

_NAMES = ("mission.json", "control", "log", "trace.jsonl", "chain.json", "store")


class OwnFolders:
    """The folders that hold the files of the agents in a run with containers. `agents` is the directory that contains
    all of these folders.
    """

    def __init__(self, agents: Path) -> None:
        self._agents = agents
        self._folders: dict[int, Path] = {}

    def mounts(self, agent_id: int, directory: Path) -> Iterator[Mount]:
        """Yield the mounts for a container whose agent runs in this directory. Raises OSError."""
        yield Mount(str(self._agents), str(self._folder(agent_id)), type="bind")
        if directory != self._agents:
            (self._folder(agent_id) / directory.name).mkdir()
            yield Mount(str(directory), str(directory), type="bind")

    def _folder(self, agent_id: int) -> Path:
        folder = self._folders.get(agent_id)
        if folder is None:
            folder = self._folders[agent_id] = self._agents / f"{agent_id}-1"
            folder.mkdir()
            for name in (f"{agent_id}.{name}" for name in _NAMES):
                link = self._agents / name
                if link.exists():
                    link.rename(folder / name)
                link.symlink_to(f"{folder.name}/{name}")
        return folder

    def merge(self) -> None:
        """Move the files of each agent to the common directory. Files with unexpected names stay in the folder of the
        agent.
        """
        for agent_id, folder in self._folders.items():
            for path in folder.iterdir():
                with contextlib.suppress(OSError):
                    if path.is_symlink():
                        continue
                    if path.is_dir():
                        path.rmdir()  # the place of a mount
                    elif path.is_socket():
                        path.unlink()  # of an agent that was killed
                    elif path.is_file() and path.name.startswith(f"{agent_id}."):
                        path.replace(self._agents / path.name)
            with contextlib.suppress(OSError):
                folder.rmdir()
        for link in self._agents.iterdir():
            if link.is_symlink() and not link.exists():
                link.unlink()

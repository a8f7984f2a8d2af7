"""Handle an agent that is a program: find its command, talk to its control socket, and read the last line of its
output.

An agent that lacks a feature of its mission ends with status 127 and a sentence on standard error
(ucp/contract/CONTRACT.md). A shell, env(1) and the first process of a container also end with 127, if they do not find
the program. In that case standard error has no sentence of an agent, and the run counts as failed instead of
unsupported.
"""

import asyncio
import json
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import from_json

from harness.errors import VIOLATED, HarnessError, ScenarioError
from harness.play.unix_sockets import short_name

FIRST_LINE_BYTES = 256
"""Number of bytes of a script's first line that the kernel reads."""


def resolve_command(command: Sequence[str], what: str) -> list[str]:
    """Return the command with absolute paths, so that it works from any directory. Raises ScenarioError if the program
    does not exist. The error message starts with `what`.
    """
    program, *arguments = command
    path = shutil.which(program)
    if path is None:
        raise ScenarioError(f"{what}: {_missing_program(program)}")
    if (interpreter := _interpreter(Path(path))) is not None and not interpreter.exists():
        raise ScenarioError(f"{what}: the first line of {program} names {interpreter}, which does not exist")
    files = (str(Path(word).absolute()) if Path(word).is_file() else word for word in arguments)
    return [str(Path(path).absolute()), *files]


def _interpreter(program: Path) -> Path | None:
    """Return the interpreter that the first line of a script names. Return None if the file is not a readable
    script.
    """
    try:
        with program.open("rb") as file:
            line = file.readline(FIRST_LINE_BYTES)
    except OSError:
        return None
    words = line.removeprefix(b"#!").split(maxsplit=1) if line.startswith(b"#!") else []
    return Path(os.fsdecode(words[0])) if words else None


def _missing_program(program: str) -> str:
    if Path(program).name != program and Path(program).is_file():
        return f"{program} is not executable: make it executable (chmod +x), or put its interpreter in front of it"
    from_here = "" if Path(program).name == program or Path(program).is_absolute() else f" from {Path.cwd()}"
    return f"{program} is not a program: give a path{from_here}, or a name on PATH"


TAIL_BYTES = 4096
MAX_CHARACTERS = 300

_SHELL_ERROR = re.compile(
    r"(.+: (line )?\d+: .*(not found|No such file or directory)"  # sh, bash
    r"|\S+: command not found: .*|fish: Unknown command.*"  # zsh, fish
    r"|(\S*/)?env: .*No such file or directory"
    r"|\[FATAL tini .*)"  # the first process of a container
)


def last_line_in(log: Path) -> str:
    """Return the last line with text in the file. Return an empty string if the file has no such line."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - TAIL_BYTES))
            return last_line(file.read().decode("utf-8", "replace"))
    except OSError:
        return ""


def last_line(text: str) -> str:
    """Return the last line that contains text, shortened and with printable characters only."""
    lines = ("".join(filter(str.isprintable, line)).strip() for line in reversed(text.splitlines()))
    return next(filter(None, lines), "")[:MAX_CHARACTERS]


def is_shell_error(words: str) -> bool:
    """Return true if the text is the message with which a shell or a similar program reports a missing program."""
    return _SHELL_ERROR.fullmatch(words) is not None


ANSWER_LIMIT_BYTES = 1024 * 1024


VERSION_CHARACTERS = 80


def _version_line(version: Any) -> str | None:
    """Return the version that an agent reports, as one line of printable text. Return None if the version is
    not text.
    """
    if not isinstance(version, str):
        return None
    return " ".join("".join(filter(str.isprintable, word)) for word in version.split())[:VERSION_CHARACTERS] or None


class AgentStatus(BaseModel):
    """The status that an agent reports (see ucp/contract/CONTRACT.md). Fields that the agent may omit have a
    default.
    """

    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)

    started: bool
    idle: bool
    reconcile_in_progress: bool
    chain: int
    deque: int
    stack: int
    completed: int
    reconciles: int
    top_chain_hash: str
    handled: int
    bytes_sent: int
    mission_s: Annotated[float, Field(allow_inf_nan=False)] | None = None
    dropped: dict[str, int] = {}
    send_failures: int | None = None
    trace_problem: str | None = None
    version: Annotated[str | None, BeforeValidator(_version_line)] = None


class AgentSilentError(Exception):
    """An error: the agent does not answer, or its control socket no longer exists."""


class AgentRefusedError(HarnessError):
    """An error: the agent refused a command. The message is the sentence that the agent sent."""

    exit_status = VIOLATED


class AgentUnsupportedError(AgentRefusedError):
    """An error: the agent answered that it does not support a command."""


class AgentControl:
    """The connection to the control socket of an agent. After a failure, the next command opens a new connection. The
    connection handles one command at a time.
    """

    def __init__(self, socket_path: Path) -> None:
        self._path = socket_path
        self._lock = asyncio.Lock()
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    @property
    def exists(self) -> bool:
        """True if the control socket exists. The check is much cheaper than an attempt to connect."""
        return self._path.exists()

    async def ask(self, command: str, *, timeout_s: float, **arguments: Any) -> dict[str, Any]:
        """Send a command to the agent and return its answer. The agent has `timeout_s` seconds of wall time to answer.

        Raises AgentSilentError, AgentRefusedError, AgentUnsupportedError.
        """
        async with self._lock:
            try:
                async with asyncio.timeout(timeout_s):
                    answer = await self._exchange({"command": command, **arguments})
            except (TimeoutError, OSError, ValueError, RecursionError) as error:
                self.close()
                what = (
                    f"no answer to {command} within {timeout_s:g} s" if isinstance(error, TimeoutError) else str(error)
                )
                raise AgentSilentError(what) from None
            except asyncio.CancelledError:
                self.close()  # a late answer on this connection would count as that of the next command
                raise
        if not answer.get("ok"):
            refused = AgentUnsupportedError if answer.get("unsupported") is True else AgentRefusedError
            raise refused(last_line(str(answer.get("error", ""))) or "no reason given")
        return answer

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None

    async def _exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        reader, writer = self._streams or await self._connect()
        writer.write(json.dumps(request).encode() + b"\n")
        await writer.drain()
        line = await reader.readline()
        if not line.endswith(b"\n"):
            raise ConnectionResetError("it closed its control socket")
        answer = from_json(line, allow_inf_nan=False)
        if not isinstance(answer, dict):
            raise ValueError("its answer is not a JSON object")
        return answer

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        self._streams = await connect(self._path)
        return self._streams


async def connect(socket_path: Path) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect to the control socket of an agent. The agent sends each answer as one line. Raises OSError."""
    with short_name(socket_path.parent) as directory:
        return await asyncio.open_unix_connection(f"{directory}/{socket_path.name}", limit=ANSWER_LIMIT_BYTES)

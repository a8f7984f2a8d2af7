"""Fuzz target: an agent's answer on its control socket. The reader must accept the answer as a status, or refuse the
answer in one sentence.
"""

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import ValidationError

from harness.play.agent_control import AgentControl, AgentRefusedError, AgentSilentError, AgentStatus
from tests.fuzz.finding import require, sound
from ucp._status import status_of
from ucp.agent import Agent


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        asyncio.run(_ask(Path(directory) / "1.control", data))


async def _ask(path: Path, data: bytes) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(data)
        writer.close()

    server = await asyncio.start_unix_server(serve, str(path))
    control = AgentControl(path)
    try:
        answer = await control.ask("status", timeout_s=10)
    except (AgentSilentError, AgentRefusedError) as error:
        sound(str(error))
    else:
        json.dumps(answer)
        try:
            status = AgentStatus.model_validate(answer)
        except ValidationError:
            return
        require(AgentStatus.model_validate_json(status.model_dump_json()) == status, "a status is read otherwise")
    finally:
        control.close()
        server.close()


def seeds(flown: Path) -> Iterator[bytes]:
    more = {"started": True, "handled": 3, "bytes_sent": 100, "mission_s": 1.5, "version": "mine 1.0"}
    yield json.dumps({"ok": True, **status_of(Agent(1, (1, 2), b"")), **more}).encode() + b"\n"
    yield b'{"ok": false, "error": "no"}\n'
    yield b'{"ok": false, "unsupported": true, "error": "never heard of"}\n'

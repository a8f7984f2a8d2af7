"""Run one agent in virtual time: `python -m ucp.node --virtual`.

The program reads lines of JSON from standard input. Each line has an input and its time. The program answers each line
with one line on standard output. The answer contains the agent's broadcasts, the time of its next timer, and its trace
lines. The program uses no socket, no file and no clock. A line with a mission starts a new agent. contract/CONTRACT.md
defines these lines for all agents.
"""

import base64
import binascii
import json
import math
import sys
from collections.abc import Callable
from random import Random
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from ucp._request import check_request
from ucp._status import status_of
from ucp.agent import Agent
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.events import LoggableEvent
from ucp.export import export_chain
from ucp.messages import MalformedDatagramError
from ucp.mission import MAX_MISSION_BYTES, Mission, MissionError, UnsupportedMissionError, is_epoch, parse_mission
from ucp.store import SecuredState, StoredState, block_on_disk
from ucp.trace import CommandEntry, HandlerRun, in_base64

if TYPE_CHECKING:
    from ucp.secure.secured_agent import SecuredAgent

LATEST_S = 1e12
"""Latest mission second. The timestamps of later events would not fit into their fields."""
MAX_LINE_BYTES = 16 * MAX_MISSION_BYTES
"""Maximum length of an input line in bytes. A mission with a store is the longest line."""


class InputError(Exception):
    """An error: a line is not a valid input. The message is one sentence."""

    def __init__(self, sentence: str, *, unsupported: bool = False) -> None:
        super().__init__(sentence)
        self.unsupported = unsupported


def serve(lines: BinaryIO, answers: BinaryIO) -> None:
    """Read lines with inputs, and write the answer to each, until the input ends."""
    agent: VirtualAgent | None = None
    while line := lines.readline(MAX_LINE_BYTES):
        try:
            given = _parse_line(line)
            if "mission" in given:
                agent = None
                agent = VirtualAgent(given)
            elif agent is None:
                raise InputError("the first line must contain a mission")
            else:
                agent.give(given)
            answer = agent.answer()
        except InputError as error:
            answer = json.dumps({"error": str(error), **({"unsupported": True} if error.unsupported else {})})
        answers.write(answer.encode("ascii") + b"\n")
        answers.flush()


class VirtualAgent:
    """An agent in virtual time, from its start to its end. The first input is a line with the keys `t`, `mission`,
    `trace` and `store`. Raises InputError.
    """

    def __init__(self, given: dict[str, Any]) -> None:
        try:
            self._mission = mission = parse_mission(given["mission"])
        except MissionError as error:
            raise InputError(str(error), unsupported=isinstance(error, UnsupportedMissionError)) from None
        if mission.store is not None or mission.events.source != "none" or mission.speedup != 1:
            raise InputError(
                "a mission in virtual time must have `store` null, `events.source` none and `speedup` 1, because it "
                "has no disk, no vehicle and no clock"
            )
        if mission.epoch_us is None:
            raise InputError(
                "`epoch_us` of the mission must be a whole number, because virtual time has no command `start`"
            )
        self._epoch_us = mission.epoch_us
        self._tracing = given.get("trace", True) is True
        self._rng = Random(mission.seed)
        """The random number generator of the agent's quirks."""
        make, self._secured = _agent_factory(mission, given), mission.security is not None
        self._agent = make(
            mission.agent_id,
            mission.roster,
            mission.initial_data,
            mission.settings,
            tracing=self._tracing,
        )
        if any(mission.quirks.values()):
            self._apply_quirks()
        self._now = -math.inf
        self._generating = True
        self._handled = self._bytes_sent = 0
        self._command_answer: dict[str, Any] | None = None
        """The answer to the last command."""
        self._traced_commands: list[CommandEntry] = []
        now = self._advance(given)
        if given.get("store") is not None:
            self._agent.boot(_parse_store(given["store"], secured=self._secured), now)

    def give(self, given: dict[str, Any]) -> None:
        """Handle one input. Raises InputError if it is refused. A refused input changes nothing, not even the agent's
        time.
        """
        earlier = self._now
        try:
            self._give(given, self._advance(given))
        except InputError:
            self._now = earlier
            raise

    def _give(self, given: dict[str, Any], now: float) -> None:
        self._command_answer = None
        if "datagram" in given:
            self._agent.receive_datagram(_decode_base64(given, "datagram"), now)
        elif "timer" in given:
            self._agent.handle_timer(now)
        elif "event_id" in given:
            self._log(given, now)
        elif "command" in given:
            self._command_answer = self._do(given, now)
        else:
            raise InputError("neither a mission, a datagram, an event, a timer nor a command")

    def answer(self) -> str:
        """Return the outputs that the last input caused, as one line of text."""
        entries = [*self._agent.trace(), *self._traced_commands]
        self._traced_commands = []
        self._handled += sum(isinstance(entry, HandlerRun) for entry in entries)
        self._agent.release_answers(self._now)
        datagrams = self._agent.datagrams_to_send()
        self._bytes_sent += sum(map(len, datagrams))
        parts = [
            f'"sent":{json.dumps([in_base64(datagram) for datagram in datagrams])}',
            f'"timer":{json.dumps(self._agent.next_timer())}',
        ]
        if self._tracing:
            parts.append(f'"trace":[{",".join(entry.to_line().rstrip() for entry in entries)}]')
        if self._command_answer is not None:
            parts.append(f'"answer":{json.dumps(self._command_answer)}')
        return "{" + ",".join(parts) + "}"

    def _advance(self, given: dict[str, Any]) -> float:
        now = given.get("t")
        if isinstance(now, bool) or not isinstance(now, int | float) or not abs(now) <= LATEST_S:
            raise InputError("`t` must be a number of mission seconds")
        if now < self._now:
            raise InputError(f"`t` goes back, from {self._now!r} to {now!r}")
        self._now = float(now)
        return self._now

    def _log(self, given: dict[str, Any], now: float) -> None:
        event_id, timestamp_us = given["event_id"], given.get("timestamp_us")
        if type(event_id) is not int or type(timestamp_us) is not int or not is_epoch(timestamp_us):
            raise InputError("an event needs `event_id` and `timestamp_us`, whole numbers, of at most 2^63-1")
        try:
            event = LoggableEvent(timestamp_us, event_id, _decode_base64(given, "data"))
            self._agent.check_size(event)
        except ValueError as error:
            raise InputError(f"the event cannot be logged: {error}") from None
        if self._generating:
            self._agent.add_event(event, now)

    # Commands, as those of the control socket

    def _do(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        name = given["command"]
        try:
            check_request(given)
        except ValueError:
            raise InputError("not a line of JSON") from None
        commands = _COMMANDS | ({"revoke": VirtualAgent._revoke} if self._secured else {})
        command = commands.get(name) if isinstance(name, str) else None
        if command is None:
            error = f"unknown command {str(name)[:40]!r}: there are {', '.join(commands)}"
            return {"ok": False, "unsupported": True, "error": error}
        return command(self, given, now)

    def _status(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        more = {"started": True, "mission_s": now, "handled": self._handled, "bytes_sent": self._bytes_sent}
        return {"ok": True, **status_of(self._agent), **more, "generating": self._generating}

    def _reconcile(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        self._agent.begin_reconcile(now)
        return {"ok": True}

    def _export(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        self._trace_command(given, now)
        exported_at_us = max(0, self._epoch_us + round(now * MICROSECONDS))
        if self._secured:
            return cast("SecuredAgent", self._agent).signed_export(exported_at_us)
        return export_chain(self._agent.state, exported_at_us)

    def _store(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        stored = StoredState.of(self._agent.state)
        if self._secured:
            stored.secured = cast("SecuredAgent", self._agent).secured_state()
        return {"ok": True, "store": _store_document(stored)}

    def _revoke(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        agent = cast("SecuredAgent", self._agent)
        try:
            agent.revoke(_decode_base64(given, "revocation"), now)
        except InputError as error:
            return {"ok": False, "error": str(error)}
        except MalformedDatagramError as malformed:
            return {"ok": False, "error": f"no revocation: {malformed.reason}"}
        return {"ok": True, "revoked": sorted(agent.revoked)}

    def _stop_events(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        self._generating = False
        self._trace_command(given, now)
        return {"ok": True}

    def _quirk(self, given: dict[str, Any], now: float) -> dict[str, Any]:
        from ucp.quirks import UnknownQuirkError, check_quirk  # correct agents do not load quirks

        name, value = str(given.get("name")), given.get("value")
        try:
            check_quirk(name, value)
        except UnknownQuirkError as error:
            return {"ok": False, "unsupported": True, "error": str(error)}
        except ValueError as error:
            return {"ok": False, "error": str(error)}
        quirks = self._mission.quirks
        quirks[name] = value  # type: ignore[assignment]  # it was checked
        self._apply_quirks()
        self._trace_command(given, now)
        return {"ok": True, **quirks}

    def _apply_quirks(self) -> None:
        from ucp.quirks import wrong_handlers

        self._agent.replace_handlers(wrong_handlers(self._mission.quirks, self._rng))

    def _trace_command(self, given: dict[str, Any], now: float) -> None:
        """Write to the trace a command that triggers no handler."""
        if self._tracing:
            request = {key: value for key, value in given.items() if key != "t"}
            self._traced_commands.append(CommandEntry(now, str(given["command"]), request))


_COMMANDS: dict[str, Callable[[VirtualAgent, dict[str, Any], float], dict[str, Any]]] = {
    "status": VirtualAgent._status,
    "reconcile": VirtualAgent._reconcile,
    "export": VirtualAgent._export,
    "store": VirtualAgent._store,
    "stop_events": VirtualAgent._stop_events,
    "quirk": VirtualAgent._quirk,
}


def _agent_factory(mission: Mission, given: dict[str, Any]) -> Callable[..., Agent]:
    """Return a function that creates the agent of the mission. The function has the arguments of `Agent`. Raises
    InputError.
    """
    if mission.security is None:
        return Agent
    try:
        from ucp.secure._secured_vehicle import virtual_agent_factory  # needs the extra `secure`
    except ModuleNotFoundError as error:
        why = f"this mission needs the feature 'secured', and {error.name} is not installed here"
        raise InputError(why, unsupported=True) from None
    try:
        return virtual_agent_factory(mission, given.get("bundle"), given.get("boot"))
    except MissionError as error:
        raise InputError(str(error)) from None


def _parse_line(line: bytes) -> dict[str, Any]:
    try:
        given = json.loads(line.decode())  # given bytes, json would also accept UTF-16
    except (ValueError, RecursionError):
        raise InputError("not a line of JSON") from None
    if not isinstance(given, dict):
        raise InputError("not a JSON object")
    return given


def _decode_base64(given: dict[str, Any], key: str) -> bytes:
    try:
        return base64.b64decode(given[key], validate=True)
    except (KeyError, TypeError, binascii.Error, ValueError):
        raise InputError(f"`{key}` must be in base64") from None


# The store of a brown-out as JSON


def _store_document(stored: StoredState) -> dict[str, Any]:
    def listed(blocks: list[Block]) -> list[list[Any]]:
        return [[block.agent_id, block.timestamp_us, in_base64(block.event_data)] for block in blocks]

    return {
        "completed": [block_hash.hex() for block_hash in stored.completed],
        "chain": listed(stored.chain),
        "deque": listed(stored.deque),
        "stack": listed(stored.stack),
        **({} if stored.secured is None else {"secured": stored.secured.entry()}),
    }


def _parse_store(value: Any, *, secured: bool) -> StoredState:
    """Parse stored data in the form of the answer to the command `store`. Raises InputError."""

    def blocks(place: str) -> list[Block]:
        return [
            block_on_disk(agent_id, timestamp_us, base64.b64decode(event_data, validate=True))
            for agent_id, timestamp_us, event_data in value[place]
        ]

    try:
        completed = [bytes.fromhex(block_hash) for block_hash in value["completed"]]
        stored = StoredState(completed, blocks("chain"), blocks("deque"), blocks("stack"))
        if secured:
            stored.secured = SecuredState(0)
            stored.secured.replay(value["secured"])
        stored.check()
        return stored
    except (KeyError, TypeError, ValueError, AttributeError):
        raise InputError("`store` is not an answer of this agent to the command `store`") from None


def main() -> int:
    """Answer each input line until standard input ends. Return exit status 0."""
    serve(sys.stdin.buffer, sys.stdout.buffer)
    return 0

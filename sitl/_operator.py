"""Record the commands that an operator sends from a ground station. The number of recorded commands is limited."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

MOST_COMMANDS = 1000
"""Maximum number of recorded commands. Further commands are only counted."""

_ASKS_ONLY = re.compile(r"MAV_CMD_(REQUEST_|GET_|SET_MESSAGE_INTERVAL$|RUN_PREARM_CHECKS$|DO_SEND_BANNER$)")
"""A pattern for the names of commands that only request data from a vehicle. Ground stations send these commands
automatically, so the commands are not recorded.
"""

_AT_THE_STICKS = frozenset({"MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"})
"""Names of messages with which an operator steers by joystick. A ground station sends them many times per second, so
consecutive messages of the same name form one entry.
"""

_COMMANDS = frozenset(
    {
        *_AT_THE_STICKS,
        "COMMAND_INT",
        "COMMAND_LONG",
        "MISSION_CLEAR_ALL",
        "MISSION_COUNT",
        "MISSION_SET_CURRENT",
        "MISSION_WRITE_PARTIAL_LIST",
        "SET_ATTITUDE_TARGET",
        "SET_HOME_POSITION",
        "SET_MODE",
        "SET_POSITION_TARGET_GLOBAL_INT",
        "SET_POSITION_TARGET_LOCAL_NED",
    }
)
_SETTINGS = frozenset({"PARAM_SET"})
"""Names of messages that change the settings of a vehicle but do not steer it."""

_ADDRESS = frozenset({"target_system", "target_component", "command", "mavpackettype"})


class CommandLog:
    """The recorded commands in order. Equal consecutive commands form one entry, which contains the number of these
    commands and the time of the last one.
    """

    def __init__(self) -> None:
        self.left_out = 0
        self._commands: list[dict[str, Any]] = []

    def note(self, message: Any, vehicle_ids: Iterable[int], at_s: float) -> bool:
        """Record an operator's message to these vehicles, if the message is a command. `at_s` is the mission second of
        the message.

        Return true if the operator takes over the vehicles from the pilot with this message.
        """
        kind = message.get_type()
        if kind not in _COMMANDS | _SETTINGS or _ASKS_ONLY.match(_command(message) or ""):
            return False
        said = {
            "vehicles": sorted(vehicle_ids),
            "message": kind,
            "command": _command(message),
            "values": _values(message),
        }
        last = self._commands[-1] if self._commands else {}
        if all(last.get(key) == value for key, value in said.items()):
            last["times"] += 1
            last["until_s"] = round(at_s, 3)
        elif len(self._commands) < MOST_COMMANDS:
            self._commands.append({"at_s": round(at_s, 3), **said, "times": 1, "until_s": round(at_s, 3)})
        else:
            self.left_out += 1
        return kind in _COMMANDS

    def to_json(self) -> list[dict[str, Any]]:
        return list(self._commands)


def _command(message: Any) -> str | None:
    """Return the name of the command in a message COMMAND_LONG or COMMAND_INT. Return None for any other message."""
    number = getattr(message, "command", None)
    if number is None:
        return None
    known = mavlink.enums["MAV_CMD"].get(number)
    return known.name if known else str(number)


def _values(message: Any) -> dict[str, object]:
    """Return the fields of the message as JSON values, without the fields that contain the address of the vehicle. For
    a joystick message, the result is empty.
    """
    if message.get_type() in _AT_THE_STICKS:
        return {}
    values = {name: getattr(message, name) for name in message.get_fieldnames() if name not in _ADDRESS}
    return {name: _as_json(value) for name, value in values.items()}


def _as_json(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (list, tuple)):
        return [_as_json(part) for part in value]
    return value if isinstance(value, (int, str)) else str(value)

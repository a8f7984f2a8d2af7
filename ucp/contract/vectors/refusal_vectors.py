"""Test vectors for missions that an agent must accept or refuse, and for requests to its control socket.

The missions are in virtual time, where an agent refuses a mission with an error. Outside virtual time, the agent
program would end with status 2. If the agent lacks a feature that the mission needs, the error is `unsupported`, and
the exit status would be 127.
"""

import json
from typing import Any

from ucp.contract.vectors._mission_story import RecordedMission
from ucp.sealed import seal_to
from ucp.trace import in_base64

UNKNOWN = "a feature of a later version"
"""The name of a feature that no agent supports."""


def vectors() -> dict[str, object]:
    """Return the test vectors. `plays` is true if an agent that has the features in `needs` must play the mission."""
    ordinary = RecordedMission().exchanges[0]["input"]["mission"]
    return {
        "about": "Missions and requests in doubt; see CONTRACT.md",
        "missions": [
            {"what": what, "mission": {**ordinary, **keys}, "needs": needs, "plays": plays}
            for what, keys, needs, plays in _missions(ordinary["settings"])
        ],
        "requests": [
            {"what": what, "line": in_base64(line), "answer": _ANSWERS[answer]} for what, line, answer in _requests()
        ],
    }


def _missions(settings: dict[str, Any]) -> list[tuple[str, dict[str, Any], list[str], bool]]:
    empty: dict[str, Any] = {"features": []}
    sealed = {"initial_data": in_base64(seal_to(b"test", bytes(32)))}
    return [
        ("an ordinary mission", {}, [], True),
        ("an agent twice on the roster", {"roster": [7, 1, 28, 7, 1]}, [], True),
        ("quirks that are off, one of them unknown", {"quirks": {"ignore_commit": 0.0, "unknown": False}}, [], True),
        ("a quirk that is on", {"quirks": {"ignore_commit": 0.5}, "features": ["quirks"]}, ["quirks"], True),
        ("a quirk that `features` does not list", {"quirks": {"ignore_commit": 1}, **empty}, ["quirks"], True),
        ("an unknown quirk", {"quirks": {"unknown": True}, "features": ["quirks"]}, [UNKNOWN], True),
        ("an unknown quirk with a text as value", {"quirks": {"unknown": "yes"}, **empty}, [UNKNOWN], True),
        ("a probability above 1", {"quirks": {"ignore_commit": 2}, "features": ["quirks"]}, ["quirks"], False),
        ("a setting that `features` does not list", {"settings": {**settings, "phase1_tie": "pop"}, **empty}, [], True),
        ("an unknown value of a setting", {"settings": {**settings, "phase1_tie": "third"}, **empty}, [], False),
        (
            "an unknown value of a setting, and its feature",
            {"settings": {**settings, "phase1_tie": "third"}, "features": ["phase1_tie=third"]},
            [UNKNOWN],
            True,
        ),
        ("a depot's key without `security`", {**sealed, **empty}, ["sealed"], False),
        ("an unknown feature and a wrong value", {"features": [UNKNOWN], "speedup": 0}, [UNKNOWN], False),
        ("a store in virtual time", {"store": "store", "features": ["store"]}, ["store"], False),
        ("random events in virtual time", {"events": {"source": "random"}}, [], False),
        ("a speedup in virtual time", {"speedup": 20}, [], False),
    ]


_ANSWERS: dict[str, dict[str, Any]] = {
    "done": {"ok": True},
    "refused": {"ok": False},
    "unknown": {"ok": False, "unsupported": True},
}


def _requests() -> list[tuple[str, bytes, str]]:
    status = json.dumps({"command": "status"})
    return [
        ("a status", status.encode(), "done"),
        ("white space around it", f" {status}\t\r".encode(), "done"),
        ("an unknown key with text that is not ASCII", '{"command":"status","é":"日本"}'.encode(), "done"),
        ("an unknown key with a surrogate pair", rb'{"command":"status","x":"\ud83d\ude00"}', "done"),
        ("the command twice, the last one known", b'{"command":"dance","command":"status"}', "done"),
        ("the command twice, the last one unknown", b'{"command":"status","command":"dance"}', "unknown"),
        ("an escaped NUL behind the command", rb'{"command":"status\u0000"}', "unknown"),
        ("an escaped NUL in another key", rb'{"command":"status","x\u0000":"\u0000"}', "done"),
        ("half a surrogate pair", rb'{"command":"status","x":"\ud800"}', "refused"),
        ("the other half of a surrogate pair", rb'{"command":"status","x":"\udc00"}', "refused"),
        ("half a surrogate pair and another character", rb'{"command":"status","x":"\ud800\u0041"}', "refused"),
        ("a broken UTF-8 character", b'{"command":"status","x":"\xc3("}', "refused"),
        ("a truncated UTF-8 character", b'{"command":"status","x":"\xe2\x82"}', "refused"),
        ("an overlong UTF-8 character", b'{"command":"status","x":"\xc0\xaf"}', "refused"),
        ("a surrogate as UTF-8", b'{"command":"status","x":"\xed\xa0\x80"}', "refused"),
        ("UTF-16", status.encode("utf-16-be"), "refused"),
        ("a byte order mark", b"\xef\xbb\xbf" + status.encode(), "refused"),
        ("a NUL byte in a text", b'{"command":"status","x":"\x00"}', "refused"),
        ("a NUL byte behind the request", status.encode() + b"\x00", "refused"),
        ("a control character in a text", b'{"command":"status","x":"\x01"}', "refused"),
        ("a command that is no text", b'{"command":["status"]}', "unknown"),
        ("no command", b"{}", "unknown"),
        ("no object", b'"status"', "refused"),
        ("an empty line", b"", "refused"),
    ]

"""A way as a scenario: the agent under test, whose peers are gone, is given the same inputs at the same times.

It can be played in virtual time, and then has all that a run has: its report, its trace, each step judged.
"""

import base64
import math
from collections.abc import Sequence
from typing import Any

from harness.conformance.reference_model import AGENT, INITIAL_DATA, PEERS, ROSTER
from harness.conformance.state_space import Variant
from harness.conformance.virtual_lines import Writer
from harness.scenario.scenario_file import Document, to_yaml
from ucp.messages import decode
from ucp.settings import Settings

COMMENT = (
    "Play it with `ucp-harness run FILE --backend sim`, for an agent that has virtual time.",
    "Its verdict on every step says where the agent did otherwise than Algorithms 1 to 20.",
)


def scenario_of(name: str, command: Sequence[str], variant: Variant, way: Sequence[str]) -> str:
    """The file."""
    script: list[Document] = []
    datagrams: list[Document] = []
    timeline: list[Document] = [{"at_s": 0, "kill": list(PEERS)}]
    writer = Writer(variant)
    for line in writer.lines(way):
        match line.given:
            case {"t": at_s, "datagram": datagram}:
                source = decode(base64.b64decode(datagram)).sender
                datagrams.append({"source": source, "datagram": datagram, "reaches": {AGENT: at_s}})
            case {"t": at_s, "event_id": event_id, "data": data, "timestamp_us": timestamp_us}:
                event = {"event_id": event_id, "data": data, "timestamp_us": timestamp_us}
                script.append({"at_s": at_s, "agent": AGENT, **event})
            case {"t": at_s, "command": asked}:
                timeline.append({"at_s": at_s, asked: [AGENT]})
    document: Document = {
        "name": name,
        "agents": list(ROSTER),
        "agent_command": {AGENT: list(command)},
        "duration_s": math.ceil(writer.now) + 1,
        "initial_data": base64.b64encode(INITIAL_DATA).decode("ascii"),
        "settings": _unusual(variant.settings.told()),
        "timeline": timeline,
        "events": {"source": "scripted"} | ({"script": script} if script else {}),
        "datagrams": datagrams,
    }
    return to_yaml({key: value for key, value in document.items() if value not in ({}, [])}, COMMENT)


def _unusual(settings: dict[str, Any]) -> dict[str, Any]:
    usual = Settings().told()
    return {name: value for name, value in settings.items() if name not in usual or usual[name] != value}

"""Write files about each failure. One of them is a scenario that gives the same inputs to the agent.

failure.txt       the expected and the received messages
vector.jsonl      the inputs and the expected answers, as `COMMAND --virtual` reads and writes them
scenario.yaml     the same inputs as a scenario, for `ucp-harness run --backend sim`
air.pcapng        the datagrams, for Wireshark and `ucp-harness packets`

The scenario runs in virtual time. Such a run has a report and a trace, and the checker judges each step. If a
timer expired late in the test, the inputs may be impossible in virtual time. In that case failure.txt reports this, and
there are no vector and no scenario.
"""

import base64
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.conformance._observation import RecordedDatagram
from harness.conformance._reference_model import AGENT, INITIAL_DATA, PEERS, ROSTER
from harness.conformance._state_space import VARIANTS, SettingsVariant
from harness.conformance._udp_lab import AGENTS_VEHICLE, PEERS_VEHICLE
from harness.conformance._virtual_lines import LineWriter, NotPlayableError
from harness.conformance.results import CaseResult
from harness.conformance.results_table import lines_of
from harness.errors import MachineError
from harness.scenario.scenario_file import Document, to_yaml
from netem.capture import begin_file
from netem.frames import udp_broadcast
from netem.pcapng import PcapngFile
from ucp.messages import PORT, decode
from ucp.settings import Settings

COMMENT = (
    "Play it with `ucp-harness run FILE --backend sim`, if the agent supports virtual time.",
    "The verdict on every step shows where the agent deviates from Algorithms 1 to 20.",
)


def scenario_of(name: str, command: Sequence[str], variant: SettingsVariant, path: Sequence[str]) -> str:
    """Return the text of a scenario that gives these inputs to the agent. Raises NotPlayableError."""
    script: list[Document] = []
    datagrams: list[Document] = []
    timeline: list[Document] = [{"at_s": 0, "kill": list(PEERS)}]
    writer = LineWriter(variant)
    for line in writer.lines(path):
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
        "settings": _non_default(variant.settings.to_json()),
        "timeline": timeline,
        "events": {"source": "scripted"} | ({"script": script} if script else {}),
        "datagrams": datagrams,
    }
    return to_yaml({key: value for key, value in document.items() if value not in ({}, [])}, COMMENT)


def _non_default(settings: dict[str, Any]) -> dict[str, object]:
    default = Settings().to_json()
    return {name: value for name, value in settings.items() if name not in default or default[name] != value}


EPOCH_US = 1_700_000_000_000_000
"""The time of mission second 0 in the capture, in microseconds since the Unix epoch."""


def keep(case: CaseResult, command: Sequence[str], directory: Path) -> None:
    """Write the files of a failure into a new directory. Raises MachineError if the files cannot be written."""
    try:
        directory.mkdir(parents=True)
        lines = list(lines_of(case))
        if case.settings in VARIANTS:
            try:
                vector = _vector(case)
                scenario = scenario_of(case.name, command, VARIANTS[case.settings], case.inputs)
            except NotPlayableError as error:
                lines.append(f"  these inputs have no scenario, because {error} is impossible in virtual time")
            else:
                (directory / "vector.jsonl").write_text(vector, encoding="utf-8")
                (directory / "scenario.yaml").write_text(scenario, encoding="utf-8")
        (directory / "failure.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        if case.exchanges:
            _write_capture(case.exchanges, directory)
    except OSError as error:
        raise MachineError(f"{directory} cannot be written: {error.strerror}") from None


def _vector(case: CaseResult) -> str:
    writer = LineWriter(VARIANTS[case.settings])
    steps: list[dict[str, Any]] = [{"in": writer.first_line(), "out": {"sent": [], "timer": None}}]
    for line in writer.lines(case.inputs):
        steps.append({"in": line.given, "out": line.answer, "says": line.input_text, "sends": line.sent_texts})
    return "".join(json.dumps(step) + "\n" for step in steps)


def _write_capture(exchanges: Sequence[RecordedDatagram], directory: Path) -> None:
    path = directory / "air.pcapng"
    begin_file(directory, AGENTS_VEHICLE, EPOCH_US, 1.0).rename(path)
    capture = PcapngFile(path)
    for exchange in exchanges:
        at_ns = EPOCH_US * 1000 + round(exchange.t * 1e9)
        frame = udp_broadcast(AGENTS_VEHICLE if exchange.sent else PEERS_VEHICLE, PORT, exchange.data)
        capture.packet(at_ns, frame, outbound=exchange.sent)
    capture.close()

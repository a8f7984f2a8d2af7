"""What is kept of a failure, in a directory of its own: to look into, and to try again without this harness.

failure.txt       what was expected and what came
vector.jsonl      the inputs and answers that lead there, as `COMMAND --virtual` reads and writes them
scenario.yaml     the same as a scenario, for `ucp-harness run --backend sim`
air.pcapng        what crossed the air, for Wireshark and `ucp-harness packets`
"""

import json
from collections.abc import Sequence
from pathlib import Path

from harness.conformance.failure_scenario import scenario_of
from harness.conformance.observation import Exchange
from harness.conformance.results import Case
from harness.conformance.results_table import lines_of
from harness.conformance.state_space import VARIANTS
from harness.conformance.udp_lab import AGENTS, PEERS_ON
from harness.conformance.virtual_lines import Writer
from harness.errors import MachineError
from netem.capture import begin_file
from netem.frames import udp_broadcast
from netem.pcapng import PcapngFile
from ucp.messages import PORT

EPOCH_US = 1_700_000_000_000_000
"""Of the capture: mission second 0."""


def keep(case: Case, command: Sequence[str], directory: Path) -> None:
    """Raises MachineError if the disk refuses."""
    try:
        directory.mkdir(parents=True)
        (directory / "failure.txt").write_text("\n".join(lines_of(case)) + "\n", encoding="utf-8")
        if case.settings in VARIANTS:
            _write_vector(case, directory / "vector.jsonl")
            scenario = scenario_of(case.name, command, VARIANTS[case.settings], case.inputs)
            (directory / "scenario.yaml").write_text(scenario, encoding="utf-8")
        if case.exchanges:
            _write_capture(case.exchanges, directory)
    except OSError as error:
        raise MachineError(f"{directory} cannot be written: {error.strerror}") from None


def _write_vector(case: Case, path: Path) -> None:
    writer = Writer(VARIANTS[case.settings])
    with path.open("w", encoding="utf-8") as file:
        file.write(json.dumps({"in": writer.first(), "out": {"sent": [], "timer": None}}) + "\n")
        for line in writer.lines(case.inputs):
            file.write(
                json.dumps({"in": line.given, "out": line.answer, "says": line.says, "sends": line.sends}) + "\n"
            )


def _write_capture(exchanges: Sequence[Exchange], directory: Path) -> None:
    path = directory / "air.pcapng"
    begin_file(directory, AGENTS, EPOCH_US, 1.0).rename(path)
    capture = PcapngFile(path)
    for exchange in exchanges:
        at_ns = EPOCH_US * 1000 + round(exchange.t * 1e9)
        frame = udp_broadcast(AGENTS if exchange.sent else PEERS_ON, PORT, exchange.data)
        capture.packet(at_ns, frame, outbound=exchange.sent)
    capture.close()

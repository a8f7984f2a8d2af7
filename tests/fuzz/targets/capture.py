"""Fuzz target: a packet capture (pcapng or pcap). The target reads the capture, joins it with another capture, and
prints the result.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.archive.packets.block_names import BlockNames
from harness.archive.packets.capture_files import read_captures
from harness.archive.packets.exchanges import RequestAnswers, count_losses
from harness.archive.packets.packets_document import document
from harness.archive.packets.pcap import OUTBOUND, CaptureFile, Frame
from harness.archive.packets.transmissions import join
from harness.errors import HarnessError
from harness.report import packets_text
from harness.report.packets_text import TransmissionFormatter
from netem.pcapng import PcapngFile, header
from tests.fuzz.finding import require, sound
from tests.fuzz.targets.home import came_home, sound_run

NAME = "1.pcapng"
_LAST_NS = 2**63 - 1
_ETHERNET = 1


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / NAME
        path.write_bytes(data)
        file = CaptureFile(path)
        try:
            _same_again([*file], Path(directory) / "again.pcapng")
        except HarnessError as error:
            sound(str(error))
        sound(file.problem)
        _show([path])
        _show([path, sound_run() / "capture" / "2.pcapng"])
    came_home(NAME, data)


def _same_again(frames: list[Frame], path: Path) -> None:
    frames = [frame for frame in frames if 0 <= frame.time_ns <= _LAST_NS]
    path.write_bytes(header("eth0", ""))
    file = PcapngFile(path)
    for frame in frames:
        file.packet(frame.time_ns, frame.data, outbound=frame.direction == OUTBOUND)
    file.close()
    again = [(frame.time_ns, frame.data) for frame in CaptureFile(path)]
    require(again == [(frame.time_ns, frame.data) for frame in frames], "frames are written otherwise")


def _show(paths: list[Path]) -> None:
    """Print the capture like `ucp-harness packets`."""
    captures = read_captures(paths)
    for sentence in (*captures.errors, *captures.problems):
        sound(sentence)
    transmissions = join(captures)
    exchanges, names = RequestAnswers(transmissions), BlockNames(transmissions, [])
    list(packets_text.transmission_lines(transmissions, exchanges, TransmissionFormatter(names, str, {}), None))
    packets_text.header(captures)
    list(packets_text.totals(captures, transmissions))
    list(document(captures, count_losses(transmissions), transmissions, exchanges, names, {}))


def seeds(flown: Path) -> Iterator[bytes]:
    capture = flown / "capture" / NAME
    yield capture.read_bytes()
    frames = [*CaptureFile(capture)][:10]
    for magic, order, fraction_ns in ((0xA1B2C3D4, "<", 1000), (0xA1B23C4D, ">", 1)):
        yield struct.pack(order + "I2H4I", magic, 2, 4, 0, 0, 65535, _ETHERNET) + b"".join(
            struct.pack(
                order + "4I",
                frame.time_ns // 10**9,
                frame.time_ns % 10**9 // fraction_ns,
                len(frame.data),
                len(frame.data),
            )
            + frame.data
            for frame in frames
        )

"""Write packet capture files for tests.

The packets are given by the test, or come from agents in a simulated network.
"""

import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from netem.addresses import BROADCAST, address, mac
from tests.ucp.air import Air
from ucp.agent import Agent
from ucp.messages import Message, encode

PORT = 14600
EPOCH_US = 1_790_000_000_000_000
SPEEDUP = 20.0
INBOUND, OUTBOUND = 1, 2


def frame(sender: int, datagram: bytes, port: int = PORT) -> bytes:
    """Return the Ethernet frame of a vehicle that broadcasts the datagram, with valid checksums."""
    addresses = bytes(int(part) for part in f"{address(sender)}.{BROADCAST}".split("."))
    udp = struct.pack("!4H", PORT, port, 8 + len(datagram), 0)
    udp_sum = checksum(addresses + struct.pack("!2H", 17, 8 + len(datagram)) + udp + datagram)
    ip = struct.pack("!2B3H2BH", 0x45, 0, 28 + len(datagram), 0, 0x4000, 64, 17, 0) + addresses
    ip = ip[:10] + struct.pack("!H", checksum(ip)) + ip[12:]
    ethernet = bytes.fromhex("ff" * 6 + mac(sender).replace(":", "") + "0800")
    return ethernet + ip + udp[:6] + struct.pack("!H", udp_sum) + datagram


def checksum(data: bytes) -> int:
    """Return the Internet checksum of RFC 1071."""
    total = sum(struct.unpack(f"!{(len(data) + 1) // 2}H", data + bytes(len(data) % 2)))
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def wall_ns(at_s: float) -> int:
    return EPOCH_US * 1000 + round(at_s * 1e9 / SPEEDUP)


class PcapNg:
    """A pcapng file that is being written."""

    def __init__(self, vehicle: int | None = None, order: str = "<", resolution: int = 9) -> None:
        self.order = order
        about = {"ucp_harness": 1, "vehicle": vehicle, "epoch_us": EPOCH_US, "speedup": SPEEDUP}
        comment = b"" if vehicle is None else self.option(1, json.dumps(about).encode())
        self.data = b""
        self.block(0x0A0D0D0A, struct.pack(order + "I2Hq", 0x1A2B3C4D, 1, 0, -1) + comment)
        self.block(1, struct.pack(order + "2HI", 1, 0, 0) + self.option(9, bytes([resolution])))

    def option(self, code: int, value: bytes) -> bytes:
        return struct.pack(self.order + "2H", code, len(value)) + value + bytes(-len(value) % 4)

    def block(self, kind: int, body: bytes) -> None:
        length = struct.pack(self.order + "I", 12 + len(body))
        self.data += struct.pack(self.order + "I", kind) + length + body + length

    def packet(self, units: int, direction: int, data: bytes, cut: int = 0) -> None:
        head = struct.pack(self.order + "5I", 0, units >> 32, units & 0xFFFFFFFF, len(data) - cut, len(data))
        data = data[: len(data) - cut]
        flags = self.option(2, struct.pack(self.order + "I", direction)) if direction else b""
        self.block(6, head + data + bytes(-len(data) % 4) + flags)

    def statistics(self, units: int, dropped: int = 0) -> None:
        head = struct.pack(self.order + "3I", 0, units >> 32, units & 0xFFFFFFFF)
        self.block(5, head + self.option(5, struct.pack(self.order + "Q", dropped)))


def pcap(packets: Iterable[tuple[int, bytes]], link_type: int = 1) -> bytes:
    """Return a file in the older pcap format. Each packet is given as its time in microseconds and its frame."""
    data = struct.pack("<I2H2i2I", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link_type)
    for time_us, packet in packets:
        data += struct.pack("<4I", *divmod(time_us, 1_000_000), len(packet), len(packet)) + packet
    return data


class CaptureScript:
    """Packet captures of scripted messages. A script gives the sender, mission second and delays of each message."""

    def __init__(self, *vehicles: int) -> None:
        self.files = {vehicle: PcapNg(vehicle) for vehicle in vehicles}
        self.sequences = dict.fromkeys(vehicles, 0)

    def send(
        self, at_s: float, sender: int, message: Message, reaches: Mapping[int, float | Sequence[float]] | None = None
    ) -> bytes:
        """Send a message. `reaches` contains the delay of each receiver in mission seconds, or the delays of several
        copies.

        By default the message reaches all other vehicles after 10 ms.
        """
        sequence = self.sequences[sender]
        self.sequences[sender] += 1
        datagram = encode(sender, sequence, message)
        self.broadcast(at_s, sender, datagram, reaches)
        return datagram

    def broadcast(
        self,
        at_s: float,
        sender: int,
        datagram: bytes,
        reaches: Mapping[int, float | Sequence[float]] | None = None,
    ) -> None:
        """Send any bytes as a datagram. `reaches` has the same meaning as for `send`."""
        self.record(sender, at_s, OUTBOUND, datagram)
        all_others = {vehicle: 0.01 for vehicle in self.files if vehicle != sender}
        for receiver, delays in (all_others if reaches is None else reaches).items():
            for delay in [delays] if isinstance(delays, float) else delays:
                self.record(receiver, at_s + delay, INBOUND, datagram)

    def record(self, vehicle: int, at_s: float, direction: int, datagram: bytes) -> None:
        """Add a datagram to the capture of a vehicle. Bytes 4 to 7 of the datagram contain its sender."""
        data = frame(int.from_bytes(datagram[4:8], "big"), datagram)
        self.files[vehicle].packet(wall_ns(at_s), direction, data)

    def finish(self, at_s: float, *vehicles: int) -> None:
        """Add the statistics that end a capture to the captures of `vehicles`. By default, do this for all vehicles."""
        for vehicle in vehicles or self.files:
            self.files[vehicle].statistics(wall_ns(at_s))

    def write(self, run: Path, *without: int) -> Path:
        return write_files(run, self.files, without)


class Captures:
    """Packet captures of all vehicles in a simulated network.

    `sent` contains the sent datagrams. `heard` contains each received datagram with its receiver.
    """

    def __init__(self, air: Air) -> None:
        self.air = air
        self.files = {agent_id: PcapNg(agent_id) for agent_id in air.agents}
        self.sent: dict[bytes, float] = {}
        self.heard: set[tuple[bytes, int]] = set()
        for agent_id, agent in air.agents.items():
            self._tap(agent_id, agent)

    def _tap(self, agent_id: int, agent: Agent) -> None:
        take, receive = agent.messages_to_send, agent.receive_datagram

        def messages_to_send() -> list[tuple[int, Message]]:
            messages = take()
            for sequence, message in messages:
                datagram = encode(agent_id, sequence, message)
                self.sent[datagram] = self.air.now
                self.packet(agent_id, OUTBOUND, frame(agent_id, datagram))
            return messages

        def receive_datagram(datagram: bytes, now: float) -> None:
            self.heard.add((datagram, agent_id))
            self.packet(agent_id, INBOUND, frame(int.from_bytes(datagram[4:8], "big"), datagram))
            receive(datagram, now)

        agent.messages_to_send = messages_to_send  # type: ignore[method-assign]
        agent.receive_datagram = receive_datagram  # type: ignore[method-assign]

    def packet(self, vehicle: int, direction: int, data: bytes) -> None:
        self.files[vehicle].packet(wall_ns(self.air.now), direction, data)

    def lost(self) -> set[tuple[bytes, int]]:
        """Return each datagram that a vehicle missed, as a pair of datagram and vehicle."""
        return {
            (datagram, listener)
            for datagram in self.sent
            for listener in self.air.agents
            if listener != int.from_bytes(datagram[4:8], "big") and (datagram, listener) not in self.heard
        }

    def write(self, run: Path, *without: int) -> Path:
        """Write complete packet captures into a run directory. Omit the captures of the vehicles in `without`."""
        for file in self.files.values():
            file.statistics(wall_ns(self.air.now))
        return write_files(run, self.files, without)


def write_files(run: Path, files: Mapping[int, PcapNg], without: Sequence[int]) -> Path:
    (run / "capture").mkdir(parents=True)
    for vehicle, file in files.items():
        if vehicle not in without:
            (run / "capture" / f"{vehicle}.pcapng").write_bytes(file.data)
    return run

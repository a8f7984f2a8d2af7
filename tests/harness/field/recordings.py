"""Write the records of a run in the formats of other recorders: CSV files, and ROS bags made by `rosbags`."""

import base64
import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from harness.archive.packets.capture_reader import NotUcpError, unwrap
from harness.archive.packets.pcap import OUTBOUND, CaptureFile

EPOCH_NS = 1_790_000_000_000_000_000


class RecordedItem(NamedTuple):
    """One record of an agent. `kind` is the value of the column `kind` in a CSV file."""

    time_ns: int
    agent: int
    kind: str
    data: bytes


def of_run(directory: Path, kinds: tuple[str, ...] = ("trace", "export")) -> Iterator[RecordedItem]:
    """Yield the records of a run, agent by agent."""
    for trace in sorted((directory / "agents").glob("*.trace.jsonl")):
        agent = int(trace.name.partition(".")[0])
        if "trace" in kinds:
            for line in trace.read_bytes().splitlines():
                yield RecordedItem(EPOCH_NS, agent, "trace", line)
        if "export" in kinds:
            yield RecordedItem(EPOCH_NS, agent, "export", (trace.parent / f"{agent}.chain.json").read_bytes())
        if "sent" in kinds:
            for frame in CaptureFile(directory / "capture" / f"{agent}.pcapng"):
                try:
                    datagram, direction = unwrap(frame)
                except NotUcpError:
                    continue
                kind = "sent" if direction == OUTBOUND else "received"
                yield RecordedItem(EPOCH_NS + frame.time_ns, agent, kind, datagram)


def write_csv(path: Path, records: Iterator[RecordedItem]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time_s", "agent", "kind", "event", "data"])
        for time_ns, agent, kind, data in records:
            text = data.decode() if kind in ("trace", "export") else base64.b64encode(data).decode()
            writer.writerow([f"{time_ns // 10**9}.{time_ns % 10**9:09}", agent, kind, "", text])
    return path


def write_bag1(path: Path, records: Iterator[RecordedItem], compression: str | None = None) -> Path:
    types = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer1(path)
    if compression:
        writer.set_compression(writer.CompressionFormat[compression])
    with writer:
        _write(writer, types, types.serialize_ros1, records, typestore=types)
    return path


def write_bag2(path: Path, records: Iterator[RecordedItem], storage: str = "sqlite3") -> Path:
    types = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        _write(writer, types, types.serialize_cdr, records, typestore=types)
    return path


def _write(
    writer: Any, types: Any, serialize: Callable[..., Any], records: Iterator[RecordedItem], **options: Any
) -> None:
    string, array = (types.types[f"std_msgs/msg/{name}"] for name in ("String", "UInt8MultiArray"))
    layout = types.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    connections: dict[str, Any] = {}
    for time_ns, agent, kind, data in records:
        topic = f"/ucp/{agent}/{kind.replace('export', 'chain')}"
        in_text = kind in ("trace", "export")
        name = "std_msgs/msg/String" if in_text else "std_msgs/msg/UInt8MultiArray"
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, name, **options)
        message = string(data=data.decode()) if in_text else array(layout=layout, data=np.frombuffer(data, np.uint8))
        writer.write(connections[topic], time_ns, serialize(message, name))

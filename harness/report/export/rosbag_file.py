"""Write a run as a ROS 2 bag for ros2 bag, RViz, rqt and PlotJuggler. ROS need not be installed.

Positions, transforms, links and logs use message types that every ROS installation contains. The agents' traces and
exports are on the topics that the bag adapter reads (`harness.field.adapters.rosbag_adapter`), so `ucp-harness import`
can turn the bag into a run directory again. The storage is SQLite, which every ROS 2 since Humble opens.
"""

import sqlite3
from collections.abc import Callable, Iterator
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

from harness.archive.history import LATEST_S
from harness.archive.traces import TraceGap, TraceHeader
from harness.errors import MachineError, extra
from harness.report.export._exported_run import ExportedRun
from harness.report.export._samples import (
    FIELD,
    CurrentLinks,
    FieldPosition,
    HandlerRunSample,
    LinkLine,
    LogLine,
    LossSample,
    Metres,
    NetworkSample,
    Sample,
    TelemetrySample,
    vehicle_frame,
)

with extra("export", "writing a ROS bag"):
    import numpy
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

Timed = tuple[int, str, Any]
"""A ROS message with its time and its topic."""

METADATA_VERSION: Literal[8] = 8
"""Version of the bag format. ROS 2 Humble and later versions read it."""
LEVELS = {"info": 20, "warning": 30, "error": 40}
"""The number of each log level in rcl_interfaces/Log, by the name of the level: INFO, WARN or ERROR."""
_LARGEST = 2**32 - 1
_STORE = get_typestore(Stores.ROS2_HUMBLE)
_NS = 1_000_000_000


def write_rosbag(recording: ExportedRun, path: Path, progress: Callable[[float], None]) -> int:
    """Write a new ROS 2 bag, and return the number of messages in it. `progress` is called repeatedly with the current
    mission second.

    Raises OSError, and MachineError if the database cannot be written.
    """
    try:
        return _write(recording, path, progress)
    except sqlite3.Error as error:
        raise MachineError(f"{path} cannot be written: {error}") from None


def _write(recording: ExportedRun, path: Path, progress: Callable[[float], None]) -> int:
    bag = _RosMessages(recording)
    written = 0
    with Writer(path, version=METADATA_VERSION, storage_plugin=StoragePlugin.SQLITE3) as writer:
        channels: dict[str, Any] = {}
        for at_ns, topic, message in bag.all():
            name = message.__msgtype__
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, name, typestore=_STORE)
            writer.write(channels[topic], at_ns, _STORE.serialize_cdr(message, name))
            written += 1
            if written % 1024 == 0:
                progress(recording.time.mission_s(at_ns))
    return written


class _RosMessages:
    """A converter from the recorded values of a run to ROS messages."""

    def __init__(self, recording: ExportedRun) -> None:
        self._recording = recording
        self._links = CurrentLinks()
        self._counts: dict[str, float] = {}

    def all(self) -> Iterator[Timed]:
        """Yield all messages in order of time."""
        traces = [self._trace(agent) for agent in self._recording.archive.traces]
        yield from merge(self._of_samples(), *traces, key=itemgetter(0))
        end_ns = self._recording.time.at(self._recording.end_s)
        for agent, export in self._recording.archive.exports.by_agent.items():
            yield (
                end_ns,
                f"/ucp/{agent}/chain",
                _message("std_msgs/msg/String", data=export.model_dump_json(by_alias=True)),
            )
        for problem in self._recording.problems:
            yield end_ns, "/rosout", _log(end_ns, LEVELS["warning"], "export", problem)

    def _trace(self, agent: int) -> Iterator[Timed]:
        """Yield the lines of the agent's trace unchanged."""
        time = self._recording.time
        at_ns = time.at(0.0, agent)
        for entry in self._recording.archive.traces[agent].entries():
            if not isinstance(entry, TraceGap | TraceHeader) and 0 <= entry.t <= LATEST_S:
                at_ns = time.at(entry.t, agent)
            if not isinstance(entry, TraceGap):
                yield at_ns, f"/ucp/{agent}/trace", _message("std_msgs/msg/String", data=entry.to_line().rstrip("\n"))

    def _of_samples(self) -> Iterator[Timed]:
        for sample in self._recording.samples():
            for topic, message in self._of(sample):
                yield sample.at_ns, topic, message

    def _of(self, sample: Sample) -> Iterator[tuple[str, Any]]:
        at_ns = sample.at_ns
        match sample:
            case FieldPosition(vehicle=vehicle):
                if (lines := self._links.move(sample)) is not None:
                    yield "/links", _markers(at_ns, lines)
                yield "/tf", _transform(sample)
                if sample.place is not None:
                    yield f"/vehicle_{vehicle}/fix", _fix(sample)
            case LossSample(losses=losses):
                self._links.losses |= losses
            case NetworkSample(mean_loss=mean, worst_loss=worst):
                yield from self._count("/network/mean_loss", "Float64", mean)
                yield from self._count("/network/worst_loss", "Float64", worst)
            case HandlerRunSample(agent=agent, run=run):
                held = {"chain": run.state.chain, "deque": run.state.deque, "stack": run.state.stack}
                for name, blocks in held.items():
                    yield from self._count(f"/agent_{agent}/{name}", "UInt32", min(max(blocks, 0), _LARGEST))
            case LogLine(level=level, source=source, text=text):
                yield "/rosout", _log(at_ns, LEVELS[level], source, text)
            case TelemetrySample(vehicle=vehicle, message=message):
                yield f"/vehicle_{vehicle}/mavlink", _bytes(bytes(message.get_msgbuf()))

    def _count(self, topic: str, kind: str, value: float) -> Iterator[tuple[str, Any]]:
        """Yield a message with the value if the value differs from the last value on this topic."""
        if self._counts.get(topic) != value:
            self._counts[topic] = value
            yield topic, _message(f"std_msgs/msg/{kind}", data=value)


def _message(name: str, /, **fields: Any) -> Any:
    """Return a new ROS message of this type."""
    return _STORE.types[name](**fields)


def _stamp(at_ns: int) -> Any:
    return _message("builtin_interfaces/msg/Time", sec=at_ns // _NS, nanosec=at_ns % _NS)


def _header(at_ns: int, frame: str) -> Any:
    return _message("std_msgs/msg/Header", stamp=_stamp(at_ns), frame_id=frame)


def _log(at_ns: int, level: int, name: str, text: str) -> Any:
    return _message(
        "rcl_interfaces/msg/Log",
        stamp=_stamp(at_ns),
        level=level,
        name=name,
        msg=text,
        file="",
        function="",
        line=0,
    )


def _bytes(data: bytes) -> Any:
    layout = _message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return _message("std_msgs/msg/UInt8MultiArray", layout=layout, data=numpy.frombuffer(data, numpy.uint8))


def _fix(position: FieldPosition) -> Any:
    assert position.place is not None
    lat_deg, lon_deg, alt_m = position.place
    return _message(
        "sensor_msgs/msg/NavSatFix",
        header=_header(position.at_ns, vehicle_frame(position.vehicle)),
        status=_message("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=lat_deg,
        longitude=lon_deg,
        altitude=alt_m,
        position_covariance=numpy.zeros(9),
        position_covariance_type=0,
    )


def _vector(kind: str, metres: Metres) -> Any:
    return _message(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", metres, strict=True)))


def _quaternion() -> Any:
    return _message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)


def _transform(position: FieldPosition) -> Any:
    transform = _message(
        "geometry_msgs/msg/TransformStamped",
        header=_header(position.at_ns, FIELD),
        child_frame_id=vehicle_frame(position.vehicle),
        transform=_message(
            "geometry_msgs/msg/Transform", translation=_vector("Vector3", position.metres), rotation=_quaternion()
        ),
    )
    return _message("tf2_msgs/msg/TFMessage", transforms=[transform])


def _markers(at_ns: int, lines: list[LinkLine]) -> Any:
    """Return one marker that contains all lines. If there are no lines, return a marker that deletes the previous
    lines, because RViz rejects an empty list.
    """
    marker: Any = _STORE.types["visualization_msgs/msg/Marker"]
    origin = (0.0, 0.0, 0.0)
    marker_message = marker(
        header=_header(at_ns, FIELD),
        ns="links",
        id=0,
        type=marker.LINE_LIST,
        action=marker.ADD if lines else marker.DELETE,
        pose=_message("geometry_msgs/msg/Pose", position=_vector("Point", origin), orientation=_quaternion()),
        scale=_vector("Vector3", (1.0, 0.0, 0.0)),
        color=_message("std_msgs/msg/ColorRGBA", r=0.0, g=1.0, b=0.0, a=1.0),
        lifetime=_message("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[_vector("Point", end) for line in lines for end in (line.low, line.high)],
        colors=[_message("std_msgs/msg/ColorRGBA", **line.colour) for line in lines for _ in range(2)],
        texture_resource="",
        texture=_message(
            "sensor_msgs/msg/CompressedImage", header=_header(at_ns, FIELD), format="", data=numpy.zeros(0, numpy.uint8)
        ),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=_message("visualization_msgs/msg/MeshFile", filename="", data=numpy.zeros(0, numpy.uint8)),
        mesh_use_embedded_materials=False,
    )
    return _message("visualization_msgs/msg/MarkerArray", markers=[marker_message])

"""Write a run as an MCAP file, which Foxglove, Lichtblick and PlotJuggler open without a plug-in.

The file uses the protobuf schemas of Foxglove for values that these schemas cover. LocationFix (for maps) and
FrameTransform (for the 3D view) contain positions, SceneUpdate contains links and vehicles, and Log contains lines of
logs. All other values become the JSON topics of `_topics`. run.json and the chain exports are attached unchanged.

The 3D view shows a shape for each vehicle, and a line for each link. The colour of a line shows the loss rate of the
link. Each vehicle is drawn once, in a coordinate frame that moves with it. Links are drawn again after movements.
"""

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from harness.archive.exports import MAX_EXPORT_BYTES, RUN_FILE, export_paths
from harness.archive.run_record import RunRecord
from harness.errors import extra
from harness.present.colours import inks
from harness.report.export._exported_run import ExportedRun
from harness.report.export._samples import (
    FIELD,
    CurrentLinks,
    FieldPosition,
    LinkLine,
    LogLine,
    LossSample,
    TelemetrySample,
    vehicle_frame,
)
from harness.report.export._topics import TopicConverter
from ucp.plain_file import read_plain_file

with extra("export", "writing MCAP"):
    from foxglove_schemas_protobuf.Color_pb2 import Color
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
    from foxglove_schemas_protobuf.Log_pb2 import Log
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from mcap.well_known import MessageEncoding, SchemaEncoding
    from mcap.writer import Writer
    from mcap_protobuf.schema import register_schema

_LEVELS = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}
_SEVERITIES = (Log.FATAL, Log.FATAL, Log.FATAL, Log.ERROR, Log.WARNING, Log.INFO, Log.INFO, Log.DEBUG)
"""Log level of each MAV_SEVERITY, from emergency to debug."""


def write_mcap(recording: ExportedRun, path: Path, progress: Callable[[float], None]) -> int:
    """Write a new MCAP file, and return the number of messages in it. `progress` is called repeatedly with the current
    mission second.

    Raises OSError.
    """
    with path.open("xb") as file:
        return _write(recording, _McapWriter(file), progress)


def _write(recording: ExportedRun, writer: "_McapWriter", progress: Callable[[float], None]) -> int:
    colours = colours_of(recording.agents)
    topics, scene = TopicConverter(recording), FieldScene(recording.archive.record, colours)
    for sample in recording.samples():
        at_ns = sample.at_ns
        match sample:
            case FieldPosition():
                writer.position(sample, colours[sample.vehicle])
                for update in scene.move(sample):
                    writer.message("/scene", at_ns, update)
            case LossSample(losses=losses):
                scene.links.losses |= losses
            case LogLine(level=level, source=source, text=text):
                writer.log(at_ns, _LEVELS[level], source, text)
            case TelemetrySample(vehicle=vehicle, message=message) if message.get_type() == "STATUSTEXT":
                severity = _SEVERITIES[min(message.severity, len(_SEVERITIES) - 1)]
                writer.log(at_ns, severity, f"vehicle {vehicle}", message.text)
        for topic, name, values in topics.of(sample):
            writer.json(topic, at_ns, name, topics.schemas[name], values)
        if writer.messages % 1024 == 0:
            progress(recording.time.mission_s(at_ns))
    end_ns = recording.time.at(recording.end_s)
    for problem in recording.problems:
        writer.log(end_ns, Log.WARNING, "export", problem)
    writer.attach(recording)
    writer.finish()
    return writer.messages


class _McapWriter:
    """A writer of an MCAP file. It declares a channel in the file before the first message of the channel."""

    def __init__(self, file: IO[bytes]) -> None:
        self._writer = Writer(file)
        self._writer.start(profile="", library="ucp-harness")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.messages = 0

    def position(self, position: FieldPosition, colour: Any) -> None:
        """Write a position as two messages: one for the map and one for the 3D view."""
        frame = vehicle_frame(position.vehicle)
        transform = FrameTransform(parent_frame_id=FIELD, child_frame_id=frame)
        transform.timestamp.FromNanoseconds(position.at_ns)
        transform.translation.x, transform.translation.y, transform.translation.z = position.metres
        transform.rotation.w = 1.0
        self.message("/tf", position.at_ns, transform)
        if position.place is not None:
            lat_deg, lon_deg, alt_m = position.place
            fix = LocationFix(frame_id=frame, latitude=lat_deg, longitude=lon_deg, altitude=alt_m, color=colour)
            fix.timestamp.FromNanoseconds(position.at_ns)
            self.message(f"/vehicles/{position.vehicle}/location", position.at_ns, fix)

    def log(self, at_ns: int, level: Any, name: str, text: str) -> None:
        line = Log(level=level, name=name, message=text)
        line.timestamp.FromNanoseconds(at_ns)
        self.message("/log", at_ns, line)

    def message(self, topic: str, at_ns: int, message: Any) -> None:
        """Write a protobuf message."""
        if topic not in self._channels:
            name = message.DESCRIPTOR.full_name
            if name not in self._schemas:
                self._schemas[name] = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.Protobuf, self._schemas[name])
        self._add(topic, at_ns, message.SerializeToString())

    def json(self, topic: str, at_ns: int, name: str, schema: dict[str, Any], values: dict[str, Any]) -> None:
        if topic not in self._channels:
            if name not in self._schemas:
                data = json.dumps({"title": name, **schema}).encode()
                self._schemas[name] = self._writer.register_schema(name, SchemaEncoding.JSONSchema, data)
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.JSON, self._schemas[name])
        self._add(topic, at_ns, json.dumps(values, separators=(",", ":"), allow_nan=False).encode())

    def _add(self, topic: str, at_ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[topic], log_time=at_ns, data=data, publish_time=at_ns)
        self.messages += 1

    def attach(self, recording: ExportedRun) -> None:
        """Attach run.json and the chain exports to the file. Unreadable files are skipped, because `problems` already
        lists them.
        """
        begin_ns = recording.time.at(0.0)
        for path in (recording.directory / RUN_FILE, *export_paths(recording.directory)):
            with contextlib.suppress(OSError):
                content = read_plain_file(path, MAX_EXPORT_BYTES)
                self._writer.add_attachment(begin_ns, begin_ns, path.name, "application/json", content)

    def finish(self) -> None:
        self._writer.finish()


_SIZE_M = 2.0
_TEXT_PX = 14.0
_LINK_PX = 2.0
_TEXT = Color(r=1.0, g=1.0, b=1.0, a=1.0)


def colours_of(vehicles: Iterable[int]) -> dict[int, Any]:
    """Return the colour of each vehicle. Reports use the same colours."""
    return {vehicle: _colour(ink.fill) for vehicle, ink in inks(vehicles).items()}


def _colour(fill: str) -> Any:
    red, green, blue = (int(fill[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return Color(r=red, g=green, b=blue, a=1.0)


class FieldScene:
    """The contents of the 3D view, which change over time. `links` contains the current loss rates."""

    def __init__(self, record: RunRecord, colours: Mapping[int, Any]) -> None:
        self.links = CurrentLinks()
        self._record, self._colours = record, colours
        self._drawn: set[int] = set()

    def move(self, position: FieldPosition) -> Iterator[Any]:
        """Yield the messages (SceneUpdate) that change the 3D view after a vehicle has moved."""
        if (lines := self.links.move(position)) is not None:
            yield _drawn_links(position.at_ns, lines)
        if position.vehicle not in self._drawn:
            self._drawn.add(position.vehicle)
            yield self._vehicle(position)

    def _vehicle(self, position: FieldPosition) -> Any:
        vehicle_record = self._record.vehicles.get(str(position.vehicle), {})
        update = SceneUpdate()
        entity = update.entities.add(id=vehicle_frame(position.vehicle), frame_locked=True)
        entity.frame_id = entity.id
        entity.timestamp.FromNanoseconds(position.at_ns)
        shapes = entity.cubes if vehicle_record.get("type") == "rover" else entity.spheres
        shape = shapes.add(color=self._colours[position.vehicle])
        shape.pose.orientation.w = 1.0
        shape.size.x = shape.size.y = shape.size.z = _SIZE_M
        if vehicle_record.get("type") == "plane":
            shape.size.y = 4 * _SIZE_M
        name = entity.texts.add(
            billboard=True, font_size=_TEXT_PX, scale_invariant=True, color=_TEXT, text=str(position.vehicle)
        )
        name.pose.position.z = 2 * _SIZE_M
        name.pose.orientation.w = 1.0
        return update


def _drawn_links(at_ns: int, links: Iterable[LinkLine]) -> Any:
    update = SceneUpdate()
    entity = update.entities.add(id="links", frame_id=FIELD)
    entity.timestamp.FromNanoseconds(at_ns)
    lines = entity.lines.add(type=LinePrimitive.LINE_LIST, thickness=_LINK_PX, scale_invariant=True)
    lines.pose.orientation.w = 1.0
    for link in links:
        for x, y, z in (link.low, link.high):
            lines.points.add(x=x, y=y, z=z)
            lines.colors.add(**link.colour)
    return update

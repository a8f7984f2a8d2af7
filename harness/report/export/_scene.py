"""Draw the swarm for Foxglove's 3D view: a shape for each vehicle, and a line for each link coloured by its loss rate.

Each vehicle is drawn once, in a coordinate frame that moves with it. Links are drawn again after movements.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from harness.archive.run_record import RunRecord
from harness.present.colours import inks
from harness.report.export._links import FIELD, CurrentLinks, LinkLine, vehicle_frame
from harness.report.export._samples import FieldPosition

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

"""The swarm in Foxglove's 3D view: a shape for each vehicle, and a line for each link, coloured by what it loses.

A vehicle is drawn once, in a frame of its own that moves. Links are drawn anew whenever vehicles have moved or losses
have changed, at most once a mission second, and of many vehicles more seldom: there are as many as pairs.
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations
from typing import Any

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from harness.archive.connectivity import Link
from harness.archive.record import RunRecord
from harness.export.samples import Position
from harness.present.colours import inks

FIELD = "field"
"""The frame of the field: x is east, y north, z up, in metres from its middle."""
PAIRS_A_SECOND = 100
_SIZE_M = 2.0
_TEXT_PX = 14.0
_LINK_PX = 2.0
_TEXT = Color(r=1.0, g=1.0, b=1.0, a=1.0)


def vehicle_frame(vehicle: int) -> str:
    return f"vehicle_{vehicle}"


def colours_of(vehicles: Iterable[int]) -> dict[int, Any]:
    """The colours that they have in reports."""
    return {vehicle: _colour(ink.fill) for vehicle, ink in inks(vehicles).items()}


def _colour(fill: str) -> Any:
    red, green, blue = (int(fill[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return Color(r=red, g=green, b=blue, a=1.0)


class Scene:
    """The scene along time; `losses` are those of the links as they are now."""

    def __init__(self, record: RunRecord, colours: Mapping[int, Any]) -> None:
        self.losses: dict[Link, float] = {}
        self._record, self._colours = record, colours
        self._places: dict[int, tuple[float, float, float]] = {}
        self._drawn_ns: int | None = None
        self._moved_ns = -1

    def moved(self, position: Position) -> Iterator[Any]:
        """SceneUpdates, if any are due."""
        at_ns = position.at_ns
        if at_ns > self._moved_ns and self._links_are_due(at_ns):  # all that moved at once have
            self._drawn_ns = at_ns
            yield self._links(at_ns)
        if position.vehicle not in self._places:
            yield self._vehicle(position)
        self._places[position.vehicle] = position.metres
        self._moved_ns = at_ns

    def _links_are_due(self, at_ns: int) -> bool:
        pairs = len(self._places) * (len(self._places) - 1) // 2
        every_ns = max(1.0, pairs / PAIRS_A_SECOND) * 1e9
        return bool(self.losses and pairs) and (self._drawn_ns is None or at_ns - self._drawn_ns >= every_ns)

    def _vehicle(self, position: Position) -> Any:
        told = self._record.vehicles.get(str(position.vehicle), {})
        update = SceneUpdate()
        entity = update.entities.add(id=vehicle_frame(position.vehicle), frame_locked=True)
        entity.frame_id = entity.id
        entity.timestamp.FromNanoseconds(position.at_ns)
        shapes = entity.cubes if told.get("type") == "rover" else entity.spheres
        shape = shapes.add(color=self._colours[position.vehicle])
        shape.pose.orientation.w = 1.0
        shape.size.x = shape.size.y = shape.size.z = _SIZE_M
        if told.get("type") == "plane":
            shape.size.y = 4 * _SIZE_M
        name = entity.texts.add(
            billboard=True, font_size=_TEXT_PX, scale_invariant=True, color=_TEXT, text=str(position.vehicle)
        )
        name.pose.position.z = 2 * _SIZE_M
        name.pose.orientation.w = 1.0
        return update

    def _links(self, at_ns: int) -> Any:
        """A link is as good as the worse of its directions; one that loses everything is not there."""
        update = SceneUpdate()
        entity = update.entities.add(id="links", frame_id=FIELD)
        entity.timestamp.FromNanoseconds(at_ns)
        lines = entity.lines.add(type=LinePrimitive.LINE_LIST, thickness=_LINK_PX, scale_invariant=True)
        lines.pose.orientation.w = 1.0
        for low, high in combinations(sorted(self._places), 2):
            loss = max(self.losses.get((low, high), 1.0), self.losses.get((high, low), 1.0))
            if loss < 1.0:
                for vehicle in (low, high):
                    x, y, z = self._places[vehicle]
                    lines.points.add(x=x, y=y, z=z)
                    lines.colors.add(r=loss, g=1.0 - loss, b=0.1, a=1.0 - 0.7 * loss)
        return update

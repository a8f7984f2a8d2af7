"""The swarm in Foxglove's 3D view: vehicles, and the links between them.

Each vehicle is drawn once, in a coordinate frame that moves with it. The links are drawn again whenever vehicles have
moved, but at most once in a mission second. With many vehicles they are drawn less often, because the number of links
grows with the square of the number of vehicles.
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations
from typing import Any, NamedTuple

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from harness.archive.connectivity import Link
from harness.archive.run_record import RunRecord
from harness.present.colours import inks
from harness.report.export._samples import Metres, Position

FIELD = "field"
"""The frame of the field: x is east, y north, z up, in metres from its middle."""
PAIRS_A_SECOND = 100


def vehicle_frame(vehicle: int) -> str:
    """The frame in which a vehicle stands still."""
    return f"vehicle_{vehicle}"


class Line(NamedTuple):
    """From one vehicle to another; `loss` is that of the worse direction, less than 1."""

    low: Metres
    high: Metres
    loss: float

    @property
    def colour(self) -> dict[str, float]:
        """From green, which loses nothing, to red, which is fainter; red, green, blue and opacity, 0 to 1."""
        return {"r": self.loss, "g": 1.0 - self.loss, "b": 0.1, "a": 1.0 - 0.7 * self.loss}


class Links:
    """`losses` are those of the links as they are now."""

    def __init__(self) -> None:
        self.losses: dict[Link, float] = {}
        self._places: dict[int, Metres] = {}
        self._drawn_ns: int | None = None
        self._moved_ns = -1

    def moved(self, position: Position) -> list[Line] | None:
        """The links before the vehicle moved, if they are to be drawn anew: all that moved at once have."""
        at_ns = position.at_ns
        due = at_ns > self._moved_ns and self._are_due(at_ns)
        lines = self._lines() if due else None
        self._drawn_ns = at_ns if due else self._drawn_ns
        self._places[position.vehicle] = position.metres
        self._moved_ns = at_ns
        return lines

    def _are_due(self, at_ns: int) -> bool:
        pairs = len(self._places) * (len(self._places) - 1) // 2
        every_ns = max(1.0, pairs / PAIRS_A_SECOND) * 1e9
        return bool(self.losses and pairs) and (self._drawn_ns is None or at_ns - self._drawn_ns >= every_ns)

    def _lines(self) -> list[Line]:
        lines = []
        for low, high in combinations(sorted(self._places), 2):
            loss = max(self.losses.get((low, high), 1.0), self.losses.get((high, low), 1.0))
            if loss < 1.0:
                lines.append(Line(self._places[low], self._places[high], loss))
        return lines


_SIZE_M = 2.0
_TEXT_PX = 14.0
_LINK_PX = 2.0
_TEXT = Color(r=1.0, g=1.0, b=1.0, a=1.0)


def colours_of(vehicles: Iterable[int]) -> dict[int, Any]:
    """The colours that they have in reports."""
    return {vehicle: _colour(ink.fill) for vehicle, ink in inks(vehicles).items()}


def _colour(fill: str) -> Any:
    red, green, blue = (int(fill[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return Color(r=red, g=green, b=blue, a=1.0)


class Scene:
    """The scene along time; `links` knows what they lose now."""

    def __init__(self, record: RunRecord, colours: Mapping[int, Any]) -> None:
        self.links = Links()
        self._record, self._colours = record, colours
        self._drawn: set[int] = set()

    def moved(self, position: Position) -> Iterator[Any]:
        """SceneUpdates, if any are due."""
        if (lines := self.links.moved(position)) is not None:
            yield _drawn_links(position.at_ns, lines)
        if position.vehicle not in self._drawn:
            self._drawn.add(position.vehicle)
            yield self._vehicle(position)

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


def _drawn_links(at_ns: int, links: Iterable[Line]) -> Any:
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

"""List ArduPilot's frames. For each frame, the list contains the type of vehicle, the model name, and the default
parameters.

The table contains the frames of ArduPilot's sim_vehicle.py that ArduPilot's own simulation can fly. The default
parameters are files of ArduPilot's Tools/autotest. The vehicle reads them in the order of the list. A user must give
the exact name of a frame. ArduPilot's programs compare only the beginning of a name. They would accept `hexacopter` as
`hexa`, but the vehicle would lack the parameters of a hexa, and would never take off.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

from sitl.vehicle import VehicleError, VehicleType

BINARIES: dict[VehicleType, str] = {"copter": "arducopter", "plane": "arduplane", "rover": "ardurover"}
DEFAULTS: dict[VehicleType, str] = {"copter": "copter.parm", "plane": "plane.parm", "rover": "rover.parm"}
"""Type of vehicle -> parameter files of ArduPilot's Tools/autotest (default_params, models), in the directory of the
binary.
"""

HELI = "arducopter-heli"


@dataclass(frozen=True)
class Airframe:
    """A frame of ArduPilot. `model` is the value for the option --model of `program`. `defaults` lists parameter
    files.
    """

    vehicle_type: VehicleType
    model: str
    defaults: tuple[str, ...]
    program: str


def airframe(name: str | None, vehicle_type: VehicleType) -> Airframe:
    """Return the frame with this name. If the name is None, return the default frame of the vehicle type. Raises
    VehicleError if no frame has this name. The error message suggests a frame with a similar name.
    """
    if name is None:
        name = USUAL[vehicle_type]
    if frame := _TABLE.get(_ALIASES.get(name, name)):
        return frame
    raise VehicleError(f"a {vehicle_type} has no frame {name!r}: {_suggestion(name, vehicle_type)}")


def _suggestion(name: str, vehicle_type: VehicleType) -> str:
    known = [frame for frame, airframe in _TABLE.items() if airframe.vehicle_type == vehicle_type]
    by_key = {frame.lower(): frame for frame in known}
    wanted = name.lower()
    if starts := [key for key in by_key if wanted.startswith(key)]:
        return f"did you mean {by_key[max(starts, key=len)]}?"
    if nearest := get_close_matches(wanted.removesuffix("copter"), by_key, n=1):
        return f"did you mean {by_key[nearest[0]]}?"
    return f"use one of {', '.join(known)}"


USUAL: dict[VehicleType, str] = {"copter": "+", "plane": "plane", "rover": "rover"}

NOT_FLOWN = {
    **dict.fromkeys(("submarine", "vectored", "vectored_6dof"), "ArduSub"),
    "blimp": "Blimp",
    "tracker": "AntennaTracker",
}
"""Frames that this pilot cannot fly, although ArduPilot binaries offer them."""

_ALIASES = {"helicopter": "heli", "boat": "motorboat", "quad": "+"}

_COPTERS: dict[str, tuple[str, ...]] = {
    "+": (),
    **{frame: (f"copter-{frame}.parm",) for frame in ("X", "bfx", "djix", "cwx", "hexa", "octa", "deca", "tri", "y6")},
    "hexax": ("copter-hexa.parm", "copter-X.parm"),
    **{f"{frame}-{order}": (f"copter-{frame}.parm", f"copter-{frame}-{order}.parm")
       for frame, order in (("hexa", "cwx"), ("hexa", "dji"), ("octa", "cwx"), ("octa", "dji"), ("deca", "cwx"))},
    "octa-quad": ("copter-octaquad.parm",),
    "octa-quad-cwx": ("copter-octaquad.parm", "copter-octaquad-cwx.parm"),
    "dodeca-hexa": ("copter-dodecahexa.parm",),
    "hexadeca-octa": ("copter-hexadeca_octa.parm",),
    "hexadeca-octa-cwx": ("copter-hexadeca_octa.parm", "copter-hexadeca_octa_cwx.parm"),
    "dotriaconta_octaquad_x": ("copter-dotriaconta_octaquad_x.parm",),
}  # fmt: skip

_ALONE: dict[str, tuple[str, ...]] = {"singlecopter": (), "coaxcopter": ("copter-coax.parm",)}

_HELICOPTERS: dict[str, tuple[str, ...]] = {
    "heli": (),
    "heli-gas": ("copter-heli-gas.parm",),
    "heli-dual": ("copter-heli-dual.parm",),
    "heli-blade360": (),
}

_PLANES: dict[str, tuple[str, ...]] = {
    "plane": (),
    "plane-elevon": ("plane-elevons.parm",),
    **{
        f"plane-{kind}": (f"plane-{kind}.parm",)
        for kind in ("vtail", "jet", "ice", "dspoilers", "redundant", "soaring")
    },
    "quadplane-tilthvec": ("quadplane-tilthvec.parm",),
}

_QUADPLANES: dict[str, tuple[str, ...]] = {
    "quadplane": (),
    **{f"quadplane-{kind}": (f"quadplane-{kind}.parm",)
       for kind in ("tilttri", "tilttrivec", "tri", "cl84", "tilt", "copter_tailsitter")},
    "quadplane-ice": ("plane-ice.parm", "quadplane-ice.parm"),
    "firefly": ("firefly.parm",),
}  # fmt: skip

_PLANES_OF_THEIR_OWN: dict[str, tuple[str, ...]] = {
    "plane-tailsitter": ("plane-tailsitter.parm",),
    "plane-3d": (),
    "glider": ("glider.parm",),
}

_ROVERS: dict[str, tuple[str, ...]] = {
    "rover": (),
    **{f"rover-{kind}": (f"rover-{kind}.parm",) for kind in ("skid", "omni3mecanum", "vectored")},
    "balancebot": ("rover-skid.parm", "balancebot.parm"),
    "motorboat": ("motorboat.parm",),
    "motorboat-skid": ("motorboat.parm", "rover-skid.parm"),
    "sailboat": ("sailboat.parm",),
    "sailboat-motor": ("sailboat-motor.parm",),
}


def _table() -> dict[str, Airframe]:
    table: dict[str, Airframe] = {}
    kinds: tuple[tuple[VehicleType, dict[str, tuple[str, ...]], tuple[str, ...], str], ...] = (
        ("copter", _COPTERS, ("copter.parm",), BINARIES["copter"]),
        ("copter", _ALONE, ("copter-single.parm",), BINARIES["copter"]),
        ("copter", _HELICOPTERS, ("copter-heli.parm",), HELI),
        ("plane", _PLANES, ("plane.parm",), BINARIES["plane"]),
        ("plane", _QUADPLANES, ("quadplane.parm",), BINARIES["plane"]),
        ("plane", _PLANES_OF_THEIR_OWN, (), BINARIES["plane"]),
        ("rover", _ROVERS, ("rover.parm",), BINARIES["rover"]),
    )
    for vehicle_type, frames, first, program in kinds:
        for name, rest in frames.items():
            table[name] = Airframe(vehicle_type, name, (*first, *rest), program)
    return table


_TABLE = _table()


def stacked(vehicle_type: VehicleType) -> list[str]:
    """Return the names of all parameter files that frames of this vehicle type need in addition to the usual file of
    the type. A frame that needs its own ArduPilot program is ignored.
    """
    program, own = BINARIES[vehicle_type], DEFAULTS[vehicle_type]
    frames = (frame for frame in _TABLE.values() if frame.program == program)
    return sorted({name for frame in frames for name in frame.defaults} - {own})

"""Test how the version and the parameters of a vehicle are requested, even if messages are lost."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from sitl._vehicle_state import FirmwareVersion
from sitl.parameters import ParameterError
from tests.sitl.puppet import message_id, on_strings


@pytest.mark.parametrize(
    ("number", "custom", "version"),
    [
        (0x04_07_00_00, b"78d42fcf", FirmwareVersion("4.7.0-dev", "78d42fcf")),
        (0x04_06_03_FF, bytes(8), FirmwareVersion("4.6.3")),
        (0x04_06_00_C1, b"\xff\xfe\0\0\0\0\0\0", FirmwareVersion("4.6.0-rc")),
        (0x04_06_00_80, b"abc\0\0\0\0\0", FirmwareVersion("4.6.0-beta", "abc")),
    ],
)
def test_version_has_its_usual_form(number: int, custom: bytes, version: FirmwareVersion) -> None:
    assert FirmwareVersion.of(number, custom) == version


def test_lost_parameters_are_requested_again(tmp_path: Path) -> None:
    async def introduce() -> None:
        async with on_strings(tmp_path, "plane") as (pilot, puppet):
            lost: list[bytes] = []

            def lose_some(frame: bytes) -> bytes:
                if message_id(frame) == mavlink.MAVLINK_MSG_ID_PARAM_VALUE and len(lost) < 2:
                    lost.append(frame)
                    return b""
                return frame

            puppet.tamper = lose_some
            await pilot.introduce({"TKOFF_ALT": 33.0})
            assert len(lost) == 2 and pilot.link.has_listed_parameters
            assert pilot.link.parameters["TKOFF_ALT"] == puppet.vehicle.take_off_altitude_m == 33
            assert pilot.state.version is not None and pilot.state.mav_type == mavlink.MAV_TYPE_FIXED_WING

    asyncio.run(introduce())


def test_unknown_parameter_is_named(tmp_path: Path) -> None:
    async def introduce() -> None:
        async with on_strings(tmp_path, "plane") as (pilot, _):
            await pilot.introduce({"TKOFF_ALT": 33.0, "TKOF_ALT": 30.0})

    with pytest.raises(ParameterError, match=r"^vehicle 3 knows no parameter TKOF_ALT: did you mean TKOFF_ALT\?$"):
        asyncio.run(introduce())


def test_vehicle_without_introduction_still_flies(tmp_path: Path) -> None:
    silent = {mavlink.MAVLINK_MSG_ID_PARAM_VALUE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION}

    async def introduce() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            puppet.tamper = lambda frame: b"" if message_id(frame) in silent else frame
            await pilot.introduce({})
            assert pilot.state.version is None and not pilot.link.parameters

    asyncio.run(introduce())

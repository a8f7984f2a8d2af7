"""Test the simulated vehicle that shows a computed flight path to a ground station."""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.plan import GoTo, Plan, TakeOff
from sitl.serial_channel import ClientChannel
from sitl.shown_vehicle import REFUSAL, ShownVehicle
from sitl.track import track
from tests.sitl.flying import HOME

NAMES = ("COMMAND_ACK", "MISSION_ACK", "PARAM_VALUE", "STATUSTEXT")


def shown() -> tuple[ShownVehicle, ClientChannel]:
    flown = track("copter", Plan((TakeOff(20.0), GoTo(100.0, 0.0))))
    vehicle = ShownVehicle(3, HOME, 0, "copter", flown)
    return vehicle, ClientChannel(vehicle)


def said(channel: ClientChannel) -> list[Any]:
    return mavlink.MAVLink(None).parse_buffer(bytearray(channel.take())) or []


def test_shown_vehicle_follows_its_track() -> None:
    vehicle, channel = shown()
    places = []
    for mission_s in (0.0, 100.0):
        vehicle.show(mission_s)
        channel.send_due()
        (place,) = [message for message in said(channel) if message.get_type() == "GLOBAL_POSITION_INT"]
        places.append(HOME.metres_to(place.lat / 1e7, place.lon / 1e7, place.alt / 1e3))
    assert [[round(part) for part in place] for place in places] == [[0, 0, 0], [100, 0, 20]]
    assert vehicle.airborne


def test_shown_vehicle_refuses_every_command_with_a_text() -> None:
    vehicle, channel = shown()
    vehicle.show(100.0)
    ground = mavlink.MAVLink(None, srcSystem=255)
    commands = (
        mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
        mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH,
        mavlink.MAV_CMD_NAV_TAKEOFF,
        mavlink.MAV_CMD_MISSION_START,
        mavlink.MAV_CMD_DO_CHANGE_SPEED,
    )
    for command in commands:
        channel.receive(mavlink.MAVLink_command_long_message(3, 1, command, 0, *[0.0] * 7).pack(ground))
        answers = {message.get_type(): message for message in said(channel)}
        assert answers["STATUSTEXT"].text == REFUSAL
        assert answers["COMMAND_ACK"].result == mavlink.MAV_RESULT_DENIED
    channel.receive(mavlink.MAVLink_mission_count_message(3, 1, 2).pack(ground))
    channel.receive(mavlink.MAVLink_param_request_list_message(3, 1).pack(ground))
    missed, parameter = [message for message in said(channel) if message.get_type() in NAMES]
    assert missed.type == mavlink.MAV_MISSION_DENIED
    assert (parameter.param_id, parameter.param_value, parameter.param_count) == ("SYSID_THISMAV", 3.0, 1)
    assert vehicle.armed

from __future__ import annotations

import math
import random
import signal
import socket
import subprocess
import time

import pytest
from pymavlink.dialects.v20 import common as mavlink

from tests.sitl.cockpit import Cockpit
from tests.sitl.flying import DEADLINE_S, HOME, Client, connect, embedded, embedded_argv, until

ACCEPTED, UNSUPPORTED, FAILED = (
    mavlink.MAV_RESULT_ACCEPTED,
    mavlink.MAV_RESULT_UNSUPPORTED,
    mavlink.MAV_RESULT_FAILED,
)
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKE_OFF = mavlink.MAV_CMD_NAV_TAKEOFF
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
SET_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
GUIDED, LAND = 4, 9


def wait_until_ready(client: Client) -> None:
    def ready() -> bool:
        health = client.wait_for("SYS_STATUS").onboard_control_sensors_health
        return bool(health & mavlink.MAV_SYS_STATUS_PREARM_CHECK)

    until(ready, "ready to arm")


def take_off(client: Client, altitude_m: float = 20.0) -> None:
    wait_until_ready(client)
    assert client.command(SET_MODE, 1, GUIDED) == ACCEPTED
    assert client.command(ARM, 1) == ACCEPTED
    assert client.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, altitude_m) == ACCEPTED


def altitude(client: Client) -> float:
    return float(client.wait_for("GLOBAL_POSITION_INT").relative_alt / 1e3)


def test_vehicle_sends_the_same_streams_as_arducopter() -> None:
    with embedded() as vehicle:
        client = Client(vehicle.pilot_port)
        heartbeat = client.wait_for("HEARTBEAT")
        assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (3, 1)
        assert (heartbeat.type, heartbeat.autopilot) == (mavlink.MAV_TYPE_QUADROTOR, 3)
        for kind in ("SYSTEM_TIME", "SYS_STATUS", "ATTITUDE", "GLOBAL_POSITION_INT"):
            client.wait_for(kind)


def test_arming_succeeds_only_after_the_vehicle_is_ready() -> None:
    with embedded(speedup=20) as vehicle:
        client = Client(vehicle.pilot_port)
        assert client.command(ARM, 1) == FAILED
        wait_until_ready(client)
        assert client.command(ARM, 1) == ACCEPTED
        until(lambda: client.wait_for("HEARTBEAT").base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED, "armed")


def test_vehicle_reports_the_reason_of_a_refusal() -> None:
    with embedded(speedup=1) as vehicle:
        client = Client(vehicle.pilot_port)
        client.sock.sendall(mavlink.MAVLink_command_long_message(3, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0).pack(client.mav))
        assert client.wait_for("STATUSTEXT").text.startswith("PreArm")


def test_take_off_needs_arming_and_guided_mode() -> None:
    with embedded() as vehicle:
        client = Client(vehicle.pilot_port)
        wait_until_ready(client)
        assert client.command(SET_MODE, 1, GUIDED) == ACCEPTED
        assert client.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 20) == FAILED
        assert client.command(SET_MODE, 1, 0) == ACCEPTED
        assert client.command(ARM, 1) == ACCEPTED
        assert client.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 20) == FAILED
        assert client.command(SET_MODE, 1, GUIDED) == ACCEPTED
        assert client.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, math.nan) == FAILED
        assert client.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 20) == ACCEPTED


def test_mode_set_directly_after_boot_is_undone() -> None:
    with embedded(speedup=10) as vehicle:
        client = Client(vehicle.pilot_port)
        assert client.command(SET_MODE, 1, GUIDED) == ACCEPTED
        client.wait_for("HEARTBEAT", custom_mode=GUIDED)
        client.wait_for("HEARTBEAT", custom_mode=0)


def test_vehicle_climbs_hovers_lands_and_disarms() -> None:
    with embedded() as vehicle:
        client = Client(vehicle.pilot_port)
        take_off(client)
        until(lambda: altitude(client) == pytest.approx(20.0), "at 20 m")
        places = {(place.lat, place.lon) for place in (client.wait_for("GLOBAL_POSITION_INT") for _ in range(10))}
        assert places == {(round(HOME.lat_deg * 1e7), round(HOME.lon_deg * 1e7))}
        assert client.command(ARM, 0) == FAILED  # not in the air
        assert client.command(SET_MODE, 1, LAND) == ACCEPTED
        until(lambda: not client.wait_for("HEARTBEAT").base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED, "disarmed")
        assert altitude(client) == 0.0


def test_unknown_commands_are_unsupported_and_foreign_ones_ignored() -> None:
    with embedded() as vehicle:
        client = Client(vehicle.pilot_port)
        assert client.command(mavlink.MAV_CMD_DO_PARACHUTE) == UNSUPPORTED
        other = mavlink.MAVLink_command_long_message(4, 1, mavlink.MAV_CMD_DO_PARACHUTE, 0, *[0.0] * 7)
        client.sock.sendall(other.pack(client.mav))
        assert client.command(ARM, 0) == ACCEPTED  # the next ACK is for this one
        assert client.command(SET_MODE, 1, 99) == FAILED


def test_messages_arrive_at_the_requested_interval() -> None:
    with embedded(speedup=10) as vehicle:
        client = Client(vehicle.pilot_port)
        assert client.command(SET_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, 2e6) == ACCEPTED
        client.wait_for("ATTITUDE")
        first, second = client.wait_for("ATTITUDE"), client.wait_for("ATTITUDE")
        assert second.time_boot_ms - first.time_boot_ms >= 1000
        assert client.command(SET_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, -1) == ACCEPTED
        assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_ATTITUDE) == ACCEPTED
        for nonsense in (math.nan, math.inf, 1e38, -5, 1.5):
            assert client.command(SET_INTERVAL, nonsense, 1e6) == FAILED
        assert client.command(SET_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, math.nan) == FAILED


def test_client_without_streams_still_gets_answers() -> None:
    with embedded() as vehicle:
        client = Client(vehicle.pilot_port)
        for message_id in (0, 1, 2, 30, 33, 42):
            assert client.command(SET_INTERVAL, message_id, -1) == ACCEPTED
        assert client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HEARTBEAT) == ACCEPTED


def test_simulated_time_runs_at_the_speedup() -> None:
    with embedded(speedup=50) as vehicle:
        client = Client(vehicle.pilot_port)
        boot, began = client.wait_for("SYSTEM_TIME").time_boot_ms, time.monotonic()
        last = until(lambda: (m := client.wait_for("SYSTEM_TIME")).time_boot_ms > boot + 25_000 and m, "25 s later")
        factor = (last.time_boot_ms - boot) / 1e3 / (time.monotonic() - began)
        assert factor == pytest.approx(50, rel=0.3)


def test_data_rate_is_bounded_at_any_speedup() -> None:
    with embedded(speedup=1000) as vehicle:
        client = Client(vehicle.pilot_port)
        client.wait_for("HEARTBEAT")
        began, messages = time.monotonic(), 0
        while (passed_s := time.monotonic() - began) < 0.5:
            client.wait_for("HEARTBEAT")
            messages += 1
        assert messages <= 20 * passed_s + 2


def test_vehicle_tolerates_garbage_and_partial_messages() -> None:
    with embedded() as vehicle:
        client = Client(vehicle.pilot_port)
        rng = random.Random(1)
        frame = mavlink.MAVLink_command_long_message(3, 1, ARM, 0, *[0.0] * 7).pack(client.mav)
        client.sock.sendall(rng.randbytes(100_000) + frame[: len(frame) // 2])
        client.sock.sendall(b"\xfd" * 1000 + bytes(600))
        assert client.command(ARM, 0) == ACCEPTED


def test_slow_client_delays_neither_vehicle_nor_other_clients() -> None:
    with embedded(speedup=200) as vehicle:
        slow = socket.socket()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        client = Client(vehicle.pilot_port)
        slow.connect(("127.0.0.1", vehicle.agent_port))
        ask = mavlink.MAVLink_command_long_message(3, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 30, *[0.0] * 6)
        frames = ask.pack(client.mav) * 100_000  # answers of about 7 MB to a client that reads none
        slow.settimeout(DEADLINE_S)
        slow.sendall(frames)
        take_off(client)
        until(lambda: altitude(client) == pytest.approx(20.0), "flying all the same")


def test_second_client_waits_until_the_first_disconnects() -> None:
    with embedded() as vehicle:
        first = Client(vehicle.pilot_port)
        first.wait_for("HEARTBEAT")
        second = connect(vehicle.pilot_port)
        second.setblocking(False)
        first.wait_for("HEARTBEAT")
        first.wait_for("HEARTBEAT")
        with pytest.raises(BlockingIOError):
            second.recv(1)
        first.sock.close()
        second.settimeout(DEADLINE_S)
        assert second.recv(1) == b"\xfd"


def test_vanished_clients_are_forgotten() -> None:
    with embedded() as vehicle:
        for _ in range(10):
            sock = connect(vehicle.agent_port)
            # The connection is reset, and not closed.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            sock.close()
        Client(vehicle.agent_port).wait_for("HEARTBEAT")


def test_simulated_time_stops_with_the_process() -> None:
    with embedded(speedup=20) as vehicle:
        client = Client(vehicle.pilot_port)
        before_ms = client.wait_for("SYSTEM_TIME").time_boot_ms
        vehicle.process.send_signal(signal.SIGSTOP)
        time.sleep(1.0)  # not a wait for luck: the vehicle is suspended for this time
        vehicle.process.send_signal(signal.SIGCONT)
        after = until(lambda: (m := client.wait_for("SYSTEM_TIME")).time_boot_ms > before_ms + 3_000 and m, "going on")
        assert after.time_boot_ms - before_ms < 15_000


def test_sigterm_ends_the_vehicle_with_status_0() -> None:
    with embedded() as vehicle:
        Client(vehicle.pilot_port).wait_for("HEARTBEAT")
        vehicle.process.send_signal(signal.SIGTERM)
        assert vehicle.process.wait(DEADLINE_S) == 0


def refusal(*argv: str) -> str:
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert ended.returncode == 2
    assert ended.stdout == ""
    (sentence,) = ended.stderr.splitlines()
    return sentence


def test_port_in_use_gives_one_sentence_and_status_2() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        sentence = refusal(*embedded_argv("--pilot-port", port, "--agent-port", "0", "--station-port", "0"))
    assert f"127.0.0.1:{port}" in sentence and "in use" in sentence


@pytest.mark.parametrize(
    ("option", "value", "problem"),
    [
        ("--home", "here", "LAT,LON,ALT,HDG"),
        ("--home", "-95,0,0,0", "latitude"),
        ("--home", "0,0,584,0", "no position"),
        ("--type", "boat", "copter"),
        ("--sysid", "300", "1 to 255"),
        ("--speedup", "0", "positive"),
        ("--speedup", "fast", "--speedup"),
        ("--pilot-port", "99999", "65535"),
    ],
)
def test_wrong_argument_gives_one_sentence_and_status_2(option: str, value: str, problem: str) -> None:
    assert problem in refusal(
        *embedded_argv("--pilot-port", "0", "--agent-port", "0", "--station-port", "0", option, value)
    )


def test_repeated_interval_requests_do_not_postpone_messages() -> None:
    cockpit = Cockpit()
    attitudes = 0
    for second in range(20):
        cockpit.vehicle.advance(float(second))
        assert cockpit.command(SET_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, 4e6) == ACCEPTED
        cockpit.channel.send_due()
        attitudes += sum(message.get_type() == "ATTITUDE" for message in cockpit.listen())
    assert attitudes == 5


def test_optional_services_are_answered() -> None:
    with embedded() as vehicle:
        client = Client(vehicle.station_port)
        for command, result in (
            (mavlink.MAV_CMD_GET_HOME_POSITION, mavlink.MAV_RESULT_ACCEPTED),
            (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, mavlink.MAV_RESULT_ACCEPTED),
            (mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION, mavlink.MAV_RESULT_UNSUPPORTED),
            (mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION, mavlink.MAV_RESULT_UNSUPPORTED),
        ):
            assert client.command(command, 1.0) == result
        for protocol_version_metadata_or_modes in (300, 397, 435):
            asked = client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, protocol_version_metadata_or_modes)
            assert asked == mavlink.MAV_RESULT_FAILED
        home_position = mavlink.MAVLINK_MSG_ID_HOME_POSITION
        message = mavlink.MAVLink_command_long_message(3, 1, 512, 0, home_position, *[0.0] * 6)
        client.sock.sendall(message.pack(client.mav))
        home = client.wait_for("HOME_POSITION")
        assert (home.latitude, home.longitude, home.altitude) == (-353632620, 1491652370, 584000)
        list_directory = [7, 0, 4, 3, 1, 0, 0, 0, 0, 0, 0, 0, ord("/")]
        payload = list_directory + [0] * (251 - len(list_directory))
        client.sock.sendall(mavlink.MAVLink_file_transfer_protocol_message(0, 3, 1, payload).pack(client.mav))
        answer = client.wait_for("FILE_TRANSFER_PROTOCOL")
        assert (answer.target_system, answer.payload[:6], answer.payload[12]) == (255, [8, 0, 4, 129, 1, 3], 7)
        client.sock.sendall(mavlink.MAVLink_log_request_list_message(3, 1, 0, 0xFFFF).pack(client.mav))
        assert client.wait_for("LOG_ENTRY").num_logs == 0
        client.sock.sendall(mavlink.MAVLink_log_request_data_message(3, 1, 1, 0, 90).pack(client.mav))
        assert client.wait_for("LOG_DATA").count == 0

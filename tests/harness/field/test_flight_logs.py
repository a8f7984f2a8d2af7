"""Test the reader of ArduPilot's flight logs: all records, GPS time, jumps of the clock, and damaged files."""

import gzip
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from pymavlink import mavutil
from pymavlink.DFReader import DFReader_binary

from harness.errors import FieldError
from harness.field import flight_logs
from harness.field.flight_logs import FlightLog, GpsTime, flight_log_kind, read_flight_log
from tests.harness.field import flight_log_files as files

WRITERS: dict[str, Callable[[], bytes]] = {"1.bin": files.dataflash_file, "1.tlog": files.telemetry_file}


def read(directory: Path, name: str, data: bytes) -> FlightLog:
    path = directory / name
    path.write_bytes(data)
    return read_flight_log(path)


def test_dataflash_log_gives_each_kind_of_record(tmp_path: Path) -> None:
    log = read(tmp_path, "1.bin", files.dataflash_file())

    assert (log.kind, log.problems, log.clock_jumps) == ("DataFlash", [], [])
    (vehicle,) = log.vehicles
    assert (vehicle.vehicle, vehicle.type_name) == (7, "copter")
    assert [(mode.name, mode.at_us) for mode in vehicle.modes] == [("GUIDED", 5_000_000), ("LAND", 65_000_000)]
    assert [arming.armed for arming in vehicle.arming] == [True, False]
    assert len(vehicle.positions) == len(vehicle.battery) == len(vehicle.gps) == len(vehicle.ekf) == 60
    position = vehicle.positions[1]
    assert (position.lat_deg, position.lon_deg) == pytest.approx((files.LAT_DEG + 10 / 111_320, files.LON_DEG))
    assert (position.alt_m, position.relative_alt_m) == (130, 30)
    assert vehicle.battery[0][2:] == (0, 12.5, 8.0, 90)
    assert vehicle.gps[0][2:] == (0, 3, 12, 0.8)
    assert vehicle.ekf[0][2:] == (831, 0.1, 0.2, 0.3, 0.4)
    assert vehicle.latest_parameters() == {"MAV_SYSID": 7, "LOG_BITMASK": 176126}
    assert log.radio[3][2:] == (197, 190, 40, 45, 100, 3, 2)


def test_telemetry_log_gives_each_kind_of_record(tmp_path: Path) -> None:
    log = read(tmp_path, "1.tlog", files.telemetry_file())

    assert (log.kind, log.problems, log.clock_jumps) == ("telemetry", [], [])
    (vehicle,) = log.vehicles
    assert (vehicle.vehicle, vehicle.type_name) == (7, "plane")
    assert [mode.name for mode in vehicle.modes] == ["AUTO", "RTL"]
    assert [arming.armed for arming in vehicle.arming] == [True]
    assert len(vehicle.positions) == len(vehicle.battery) == len(vehicle.gps) == len(vehicle.ekf) == 60
    position = vehicle.positions[1]
    assert (position.lat_deg, position.lon_deg) == pytest.approx((files.LAT_DEG + 10 / 111_320, files.LON_DEG))
    assert (position.alt_m, position.relative_alt_m) == (130, 30)
    assert vehicle.battery[0][2:] == (0, 12.5, 8.0, 90)
    assert vehicle.gps[0][2:] == (0, 3, 12, 0.8)
    assert vehicle.ekf[0].flags == 831
    assert vehicle.latest_parameters() == {"MAV_SYSID": 7}
    assert log.radio[3][2:] == (197, 190, 40, 45, 100, 3, 2)


def test_positions_equal_those_of_pymavlink(tmp_path: Path) -> None:
    logs = {name: read(tmp_path, name, writer()) for name, writer in WRITERS.items()}

    theirs = DFReader_binary(str(tmp_path / "1.bin"))
    expected = []
    while (message := theirs.recv_match(type="POS")) is not None:
        expected.append((message.TimeUS, message.Lat, message.Lng, message.Alt, message.RelHomeAlt))
    ours = [(each.at_us, *each[2:]) for each in logs["1.bin"].vehicles[0].positions]
    assert ours == expected

    telemetry = mavutil.mavlink_connection(str(tmp_path / "1.tlog"))
    expected = []
    while (message := telemetry.recv_match(type="GLOBAL_POSITION_INT")) is not None:
        expected.append((message.lat / 1e7, message.lon / 1e7, message.alt / 1000, message.relative_alt / 1000))
    assert [each[2:] for each in logs["1.tlog"].vehicles[0].positions] == expected


def test_gps_time_has_week_milliseconds_and_leap_seconds(tmp_path: Path) -> None:
    (vehicle,) = read(tmp_path, "1.bin", files.dataflash_file()).vehicles

    utc_us = files.BOOT_UTC_US + 5_000_000
    assert vehicle.gps_times[0] == GpsTime(5_000_000, utc_us, files.WEEK, files.WEEK_MS + 5000, 18)


def test_gps_time_corrects_all_records_of_a_dataflash_log(tmp_path: Path) -> None:
    log = read(tmp_path, "1.bin", files.dataflash_file())

    (vehicle,) = log.vehicles
    for records in (vehicle.positions, vehicle.modes, vehicle.arming, vehicle.battery, log.radio):
        assert all(record.utc_us == files.BOOT_UTC_US + record.at_us for record in records)


def test_gps_time_corrects_the_clock_of_the_computer(tmp_path: Path) -> None:
    messages = files.telemetry_messages(ahead_us=7_300_000)
    log = read(tmp_path, "1.tlog", files.telemetry_file(messages))

    records = (*log.vehicles[0].positions, *log.radio)
    assert all(record.utc_us == record.at_us + 7_300_000 for record in records)


def test_single_wrong_gps_time_does_not_move_the_records(tmp_path: Path) -> None:
    messages = [*files.flight_messages()]
    wrong = files.dataflash("GPS", 30_000_000, 0, 3, files.WEEK_MS, files.WEEK, 12, 1, 48, 2, 130, 0, 0, 0, 0, 1)
    where = next(i for i, each in enumerate(messages) if each[2] == 66 and each[3:11] == wrong[3:11])
    messages[where] = wrong
    (vehicle,) = read(tmp_path, "1.bin", files.dataflash_file(messages)).vehicles

    assert all(
        abs(each.utc_us - files.BOOT_UTC_US - each.at_us) < 1_000_000 for each in vehicle.positions if each.utc_us
    )


def test_log_without_gps_time_has_no_utc(tmp_path: Path) -> None:
    messages = (message for message in files.flight_messages() if message[2] != files.DEFINITIONS["GPS"][0])
    (vehicle,) = read(tmp_path, "1.bin", files.dataflash_file(messages)).vehicles

    assert len(vehicle.positions) == 60
    assert {position.utc_us for position in vehicle.positions} == {None}


def test_log_without_estimate_has_positions_of_the_receiver(tmp_path: Path) -> None:
    messages = (message for message in files.flight_messages() if message[2] != files.DEFINITIONS["POS"][0])
    log = read(tmp_path, "1.bin", files.dataflash_file(messages))

    assert len(log.vehicles[0].positions) == 60
    assert log.vehicles[0].positions[0].utc_us == files.BOOT_UTC_US + 5_000_000
    assert log.problems == ["the positions are those of the GPS receiver, because the log has no POS messages"]


def test_telemetry_log_of_two_vehicles_separates_them(tmp_path: Path) -> None:
    pairs = zip(files.telemetry_messages(vehicle=3), files.telemetry_messages(vehicle=4), strict=True)
    log = read(tmp_path, "1.tlog", files.telemetry_file(frame for pair in pairs for frame in pair))

    assert [vehicle.vehicle for vehicle in log.vehicles] == [3, 4]
    assert [len(vehicle.positions) for vehicle in log.vehicles] == [60, 60]


@pytest.mark.parametrize("name", WRITERS)
def test_truncated_log_keeps_the_records_before_its_end(tmp_path: Path, name: str) -> None:
    data = WRITERS[name]()
    whole = read(tmp_path, name, data).vehicles[0].positions
    before = 0
    for size in range(len(data) // 2, len(data), 997):
        (vehicle,) = read(tmp_path, name, data[:size]).vehicles
        assert [each[2:] for each in vehicle.positions] == [each[2:] for each in whole[: len(vehicle.positions)]]
        assert len(vehicle.positions) >= max(before, 20)
        before = len(vehicle.positions)


@pytest.mark.parametrize("name", WRITERS)
def test_lost_bytes_affect_only_their_messages(tmp_path: Path, name: str) -> None:
    data = WRITERS[name]()
    whole = {each[2:] for each in read(tmp_path, name, data).vehicles[0].positions}
    half = len(data) // 2
    for log in (
        read(tmp_path, name, data[:half] + data[half + 37 :]),
        read(tmp_path, name, data[:half] + bytes(500) + data[half + 500 :]),
        read(tmp_path, name, data[:half] + Random(1).randbytes(300) + data[half:]),
    ):
        positions = {each[2:] for each in log.vehicles[0].positions}
        assert positions <= whole
        assert len(positions) >= 57
        assert any("are no whole message and are skipped" in problem for problem in log.problems)


def test_message_with_lost_bytes_gives_no_false_position(tmp_path: Path) -> None:
    messages = [*files.flight_messages()]
    where = [number for number, each in enumerate(messages) if each[2] == files.DEFINITIONS["POS"][0]][30]
    whole = messages[where]
    messages[where] = whole[:15] + whole[19:]  # without the longitude, the next four bytes are a longitude as well
    (vehicle,) = read(tmp_path, "1.bin", files.dataflash_file(messages)).vehicles

    assert len(vehicle.positions) == 59
    assert {position.lon_deg for position in vehicle.positions} == {files.LON_DEG}


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_log_raises_nothing_but_its_own_error(tmp_path: Path, name: str) -> None:
    rng, data = Random(name), WRITERS[name]()[:6000]
    for _ in range(150):
        damaged = bytearray(data)
        for _ in range(rng.choice((1, 5, 100))):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        start = rng.choice((0, 0, rng.randrange(len(damaged))))
        try:
            log = read(tmp_path, name, bytes(damaged[start:]))
        except FieldError as error:
            assert "not a flight log" in str(error)
        else:
            assert all("\n" not in problem for problem in log.problems)


@pytest.mark.parametrize("name", WRITERS)
def test_random_bytes_have_no_records(tmp_path: Path, name: str) -> None:
    for seed in range(20):
        try:
            log = read(tmp_path, name, Random(seed).randbytes(20_000))
        except FieldError:
            continue
        assert not any(vehicle.positions for vehicle in log.vehicles)
        assert log.problems


@pytest.mark.parametrize(("name", "mark"), [("1.bin", b"\xa3\x95"), ("1.tlog", b"\xfe" + bytes(6))])
def test_endless_false_beginnings_end_the_reading(tmp_path: Path, name: str, mark: bytes) -> None:
    log = read(tmp_path, name, WRITERS[name]() + mark * 550_000)

    assert len(log.vehicles[0].positions) == 60
    assert any("because the file has too much damage" in problem for problem in log.problems)


def test_clock_that_goes_back_is_a_jump(tmp_path: Path) -> None:
    messages = [*files.flight_messages(), *files.flight_messages(first_us=2_000_000)]
    log = read(tmp_path, "1.bin", files.dataflash_file(messages))

    assert [(jump.at_us, jump.by_us) for jump in log.clock_jumps] == [(65_000_000, -63_000_000)]
    assert "its clock jumps once, first by -63.0 s (a restart, a correction or a pause)" in log.problems
    after = [each for each in log.vehicles[0].positions if each.at_us < 5_000_000]
    assert all(each.utc_us == files.BOOT_UTC_US + each.at_us for each in after)


def test_single_record_with_a_wrong_time_is_left_out(tmp_path: Path) -> None:
    messages = [*files.flight_messages()]
    messages.insert(100, files.dataflash("POS", 10**12, 48, 2, 130, 30, 30))
    log = read(tmp_path, "1.bin", files.dataflash_file(messages))

    assert log.clock_jumps == []
    assert len(log.vehicles[0].positions) == 60
    assert log.problems == ["1 record is left out, because the time of each differs from the times before and after it"]


def test_impossible_positions_are_left_out(tmp_path: Path) -> None:
    messages = [
        *files.flight_messages(seconds=2),
        files.dataflash("POS", 7_000_000, 0.0003, -0.0001, 0, 0, 0),
        files.dataflash("POS", 7_000_000, 48, 2, float("nan"), 0, 0),
        files.dataflash("POS", 7_000_000, 148, 2, 0, 0, 0),
    ]
    assert len(read(tmp_path, "1.bin", files.dataflash_file(messages)).vehicles[0].positions) == 2


def test_log_without_definitions_names_the_reason(tmp_path: Path) -> None:
    log = read(tmp_path, "1.bin", b"".join(files.flight_messages()))

    assert log.vehicles[0].positions == []
    assert "no message can be decoded; messages of type FMT at the beginning define all others" in log.problems


@pytest.mark.parametrize("name", WRITERS)
def test_packed_log_is_read(tmp_path: Path, name: str) -> None:
    assert len(read(tmp_path, name, gzip.compress(WRITERS[name]())).vehicles[0].positions) == 60


def test_other_files_are_no_flight_logs(tmp_path: Path) -> None:
    for name, data in (("1.bin", b"\x7fELF" + bytes(3000)), ("1.txt", b"\xa3\x95"), ("1.tlog", b"")):
        with pytest.raises(FieldError, match=f"{name}: not a flight log"):
            read(tmp_path, name, data)
    with pytest.raises(FieldError, match="cannot be read"):
        read_flight_log(tmp_path)


@pytest.mark.parametrize("beginning", [b"", b"{}", b'{"schema": "ucp-trace/2"}\n', b"Notes of \xfd5 November\n"])
def test_other_files_need_no_message_definitions(monkeypatch: pytest.MonkeyPatch, beginning: bytes) -> None:
    """Loading the message definitions of pymavlink takes 110 MiB of memory."""
    monkeypatch.setattr(flight_logs, "_begins_with_frame", lambda beginning: pytest.fail("pymavlink is imported"))
    assert flight_log_kind(Path("10.trace.jsonl"), beginning) is None


def test_kind_is_recognised_by_content() -> None:
    assert flight_log_kind(Path("a"), files.dataflash_file()[:100]) == "DataFlash"
    assert flight_log_kind(Path("a"), files.telemetry_file()[:100]) == "telemetry"
    assert flight_log_kind(Path("a"), b"{}") is None

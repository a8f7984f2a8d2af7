"""Test `calibrate` with flights whose radio parameters are known, and with incomplete records."""

import json
import math
import shutil
from pathlib import Path
from random import Random

import pytest

from benchmarks.calibrating import calibrated, covered
from harness.archive.traces import read_trace
from harness.errors import FieldError
from harness.field.calibrate._delivery_model import DeliveryModel, TransmissionAttempt, fit, student
from harness.field.calibrate.calibration import CalibrationResult, calibrate, model_of, validate
from harness.scenario import Scenario
from harness.scenario.load import load_scenario
from netem.radio import LogDistance
from tests.harness.command import harness
from tests.harness.field import flight_log_files as files
from ucp.trigger import MessageTrigger

TRUTH = DeliveryModel(range_m=400.0, spread=0.4, floor=0.05)
EPOCH_US = 1_790_000_000_000_000


def attempts(
    seed: int, number: int = 1500, truth: DeliveryModel = TRUTH, lasting: int = 1
) -> list[TransmissionAttempt]:
    """Draw random transmissions over six links. On each link, `lasting` successive messages have the same shadowing."""
    rng, drawn = Random(seed), []
    for block in range(number // lasting):
        deviation, link = rng.gauss(0, 1), rng.randrange(6)
        distance_m = math.exp(rng.uniform(math.log(50), math.log(1500)))
        for _ in range(lasting):
            arrives = truth.spread * deviation < math.log(truth.range_m / distance_m) and rng.random() > truth.floor
            drawn.append(TransmissionAttempt(block * lasting * 1200 / number, 0, 1 + link, distance_m, arrives))
            deviation = deviation if lasting > 1 else rng.gauss(0, 1)
    return drawn


def test_intervals_cover_the_parameters_in_most_cases() -> None:
    inside = {"range_m": 0, "spread": 0, "floor": 0}
    for seed in range(10):
        fitted = fit(attempts(seed, 400))
        assert fitted is not None
        for name in inside:
            inside[name] += getattr(TRUTH, name) in fitted.intervals[name]
    assert all(count >= 9 for count in inside.values()), inside


def test_shared_shadowing_widens_the_intervals() -> None:
    def width(lasting: int) -> float:
        fits = [fit(attempts(seed, 900, lasting=lasting)) for seed in range(3)]
        return sum(math.log(each.intervals["range_m"].high / each.intervals["range_m"].low) for each in fits if each)

    assert width(15) > 1.6 * width(1)


def test_fit_equals_the_maximum_of_the_likelihood() -> None:
    fitted = fit(attempts(2))
    assert fitted is not None

    def likelihood(model: DeliveryModel) -> float:
        return sum(
            math.log(model.delivery(each.distance_m) if each.delivered else 1 - model.delivery(each.distance_m))
            for each in attempts(2)
        )

    model = fitted.model
    best = likelihood(model)
    for factor in (0.97, 1.03):
        assert likelihood(DeliveryModel(model.range_m * factor, model.spread, model.floor)) < best
        assert likelihood(DeliveryModel(model.range_m, model.spread * factor**2, model.floor)) < best


def test_load_increases_the_fitted_loss() -> None:
    rng = Random(3)
    drawn = [
        each._replace(others=others, delivered=each.delivered and rng.random() > 0.2 * others)
        for each in attempts(3)
        for others in [rng.choice((0, 0, 1))]
    ]
    fitted = fit(drawn)
    assert fitted is not None
    assert -math.log(0.8) in fitted.intervals["load"]
    assert fitted.intervals["load"].low > 0.1


def test_exponent_and_shadowing_are_not_both_identified() -> None:
    one = LogDistance(exponent=2.0, shadowing_db=3.0)
    two = LogDistance(exponent=4.0, shadowing_db=6.0)
    two = LogDistance(exponent=4.0, shadowing_db=6.0, power_dbm=two.power_dbm - two.margin_db(model_of(one).range_m))
    for distance_m in (50, 200, 500, 1000):
        assert 1 - one.loss(distance_m) == pytest.approx(1 - two.loss(distance_m))
        assert model_of(one).delivery(distance_m) == pytest.approx(1 - one.loss(distance_m))


@pytest.mark.parametrize("delivered", [True, False])
def test_messages_that_all_share_one_fate_determine_no_range(delivered: bool) -> None:
    assert fit([each._replace(delivered=delivered) for each in attempts(4)]) is None


def test_equal_distances_determine_no_range() -> None:
    assert fit([each._replace(distance_m=300.0) for each in attempts(4)]) is None


def test_validation_predicts_the_end_better_than_one_loss() -> None:
    validation = validate(attempts(5))
    assert validation is not None
    assert validation.log_score < validation.constant_log_score
    assert validation.brier < validation.constant_brier
    assert all(abs(predicted - share) < 0.25 for count, predicted, share in validation.bins if count > 30)


def test_quantiles_equal_those_of_the_tables() -> None:
    assert [student(freedom) for freedom in (3, 5, 10, 30)] == pytest.approx([3.182, 2.571, 2.228, 2.042], rel=4e-3)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CalibrationResult, DeliveryModel]:
    directory = tmp_path_factory.mktemp("calibrate") / "run"
    calibration, truth = calibrated(1, directory, agents=4, duration_s=600.0)
    return directory, calibration, truth


def test_simulated_flight_is_fitted(flown: tuple[Path, CalibrationResult, DeliveryModel]) -> None:
    _, calibration, truth = flown
    assert calibration.source == "captures"
    assert covered(calibration, truth) == {"range_m": True, "spread": True, "floor": True}


def _taken_home(run: Path, directory: Path, vehicles: tuple[int, ...]) -> Path:
    """Copy the traces in the form that real flights record. Write flight logs of `vehicles` in place of
    `tracks.jsonl`.
    """
    directory.mkdir()
    for trace in (run / "agents").glob("*.trace.jsonl"):
        text = trace.read_text().replace('"epoch_us":0', f'"epoch_us":{EPOCH_US}')
        (directory / trace.name).write_text(text)
    lines = [json.loads(line) for line in (run / "tracks.jsonl").read_text().splitlines()]
    for vehicle in vehicles:
        boot_us = 5_000_000
        messages = [files.dataflash("PARM", boot_us, b"SYSID_THISMAV", vehicle, 1)]
        for line in lines:
            at_us = boot_us + round(line["at_s"] * 1e6)
            north, east, up = line["places"][str(vehicle)]
            lat = files.LAT_DEG + north / 111_195
            lon = files.LON_DEG + east / 111_195 / math.cos(math.radians(files.LAT_DEG))
            gps_us = EPOCH_US + at_us - boot_us - (315_964_800 - 18) * 1_000_000
            week, week_ms = gps_us // 604_800_000_000, gps_us // 1000 % 604_800_000
            messages.append(files.dataflash("GPS", at_us, 0, 3, week_ms, week, 12, 1, lat, lon, up, 0, 0, 0, 0, 1))
            messages.append(files.dataflash("POS", at_us, lat, lon, up, up, up))
        (directory / f"log{vehicle}.bin").write_bytes(files.dataflash_file(messages))
    return directory


def test_flight_on_a_shared_channel_is_fitted(tmp_path: Path) -> None:
    # An answer needs a good link to the agent that asked. If such answers counted, the interval would miss the range.
    calibration, truth = calibrated(21, tmp_path / "run", channel="wifi_6")
    assert covered(calibration, truth) == {"range_m": True, "spread": True, "floor": True}


def test_answer_in_a_trace_does_not_count_at_the_agent_that_asked(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    directory = _taken_home(flown[0], tmp_path / "home", (1, 2, 3, 4))
    traces = {agent_id: read_trace(directory / f"{agent_id}.trace.jsonl") for agent_id in (1, 2, 3, 4)}
    answers = {
        (agent_id, round(run.t, 3)): run.trigger.sender
        for agent_id, trace in traces.items()
        for run in (trace.runs if trace else ())
        if isinstance(run.trigger, MessageTrigger) and run.sent
    }
    attempts = [(each, answers.get((each.sender, round(each.at_s, 3)))) for each in calibrate([directory]).attempts]
    assert len([each for each, asking in attempts if asking is not None]) > 20
    assert not [each for each, asking in attempts if asking == each.receiver]


def test_flight_logs_give_the_distances_of_the_run(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    run, _, _ = flown
    calibration = calibrate([_taken_home(run, tmp_path / "home", (1, 2, 3, 4))])

    assert calibration.source == "traces"
    assert calibration.positions.sources == {vehicle: f"log{vehicle}.bin" for vehicle in (1, 2, 3, 4)}
    assert calibration.problems == []
    known = calibrate([run]).positions
    for attempt in calibration.attempts:
        expected_m = known.distance_m(attempt.sender, attempt.receiver, attempt.at_s)
        assert expected_m is not None
        assert attempt.distance_m == pytest.approx(expected_m, abs=1.0, rel=0.01)


def test_vehicle_without_positions_is_named(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    calibration = calibrate([_taken_home(flown[0], tmp_path / "home", (1, 2))])

    assert {attempt.link for attempt in calibration.attempts} == {frozenset((1, 2))}
    assert "vehicles without positions: 3, 4; messages from and to them are not used" in calibration.problems


def test_flight_without_positions_is_refused_with_the_reason(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    with pytest.raises(FieldError, match="no message has a known receiver and known distance") as caught:
        calibrate([_taken_home(flown[0], tmp_path / "home", ())])
    assert any("vehicles without positions: 1, 2, 3, 4" in sentence for sentence in caught.value.details)


def test_records_of_one_vehicle_are_refused_with_the_reason(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    home = _taken_home(flown[0], tmp_path / "home", (1, 2, 3, 4))
    for agent_id in (2, 3, 4):
        (home / f"{agent_id}.trace.jsonl").unlink()
    with pytest.raises(FieldError) as caught:
        calibrate([home])
    assert any("records of one vehicle only" in sentence for sentence in caught.value.details)


def test_messages_after_a_clock_jump_are_left_out(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    home = _taken_home(flown[0], tmp_path / "home", (1, 2, 3, 4))
    before = calibrate([home])
    trace = home / "2.trace.jsonl"
    header, *lines = trace.read_text().splitlines()
    half = len(lines) // 2
    late = []
    for line in lines[half:]:
        run = json.loads(line)
        late.append(json.dumps({**run, "t": run["t"] - 90}, separators=(",", ":")))
    trace.write_text("\n".join([header, *lines[:half], *late]) + "\n")
    calibration = calibrate([home])

    assert any("agent 2: its clock jumps" in problem for problem in calibration.problems)
    jump_s = json.loads(lines[half])["t"]
    sent_s = {attempt.at_s for attempt in before.attempts if attempt.sender == 2 and attempt.at_s < jump_s}
    assert {attempt.at_s for attempt in calibration.attempts if attempt.sender == 2} == sent_s
    assert max(attempt.at_s for attempt in calibration.attempts if attempt.sender == 1) > jump_s


def test_signal_strengths_determine_the_exponent(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    home = _taken_home(flown[0], tmp_path / "home", (1, 2, 3, 4))
    rng, messages = Random(1), [files.dataflash("PARM", 5_000_000, b"SYSID_THISMAV", 2, 1)]
    for second in range(600):
        at_us, north_m = 5_000_000 + second * 1_000_000, abs(300 - second) * 3.0
        lat = files.LAT_DEG + (900 - north_m) / 111_195
        gps_us = EPOCH_US + second * 1_000_000 - (315_964_800 - 18) * 1_000_000
        week, week_ms = gps_us // 604_800_000_000, gps_us // 1000 % 604_800_000
        messages.append(files.dataflash("GPS", at_us, 0, 3, week_ms, week, 12, 1, lat, 2.0, 0, 0, 0, 0, 0, 1))
        messages.append(files.dataflash("POS", at_us, lat, 2.0, 0, 0, 0))
        strength_db = 120 - 27 * math.log10(max(900 - north_m, 1.0)) + rng.gauss(0, 3)
        messages.append(files.dataflash("RAD", at_us, max(1, round(1.9 * strength_db)), 1, 100, 40, 45, 0, 0))
    (home / "log2.bin").write_bytes(files.dataflash_file(messages))
    calibration = calibrate([home])

    assert calibration.signal is not None
    assert 2.7 in calibration.signal.interval
    assert calibration.exponent == calibration.signal.exponent


def test_command_writes_a_scenario_that_runs(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    run, calibration, _ = flown
    out, page = tmp_path / "fitted.yaml", tmp_path / "page.html"
    done = harness("calibrate", run, "-o", out, "--html", page)

    assert done.returncode == 0, done.stderr
    assert f"half of the messages arrive at {calibration.fit.model.range_m:.0f} m" in done.stdout  # type: ignore[union-attr]
    assert all(word in page.read_text() for word in ("Delivery over distance", "Validation", "Map", "1 and 2"))
    played = harness("run", out, "--backend", "sim", "--out", tmp_path / "again")
    assert played.returncode in (0, 1, 4), played.stderr
    network = Scenario.model_validate(json.loads((tmp_path / "again" / "run.json").read_text())["scenario"]).network
    assert network.radio is not None and network.radio.log_distance is not None
    radio = LogDistance(**network.radio.log_distance.model_dump())
    assert model_of(radio).range_m == pytest.approx(calibration.fit.model.range_m, rel=1e-3)  # type: ignore[union-attr]
    assert harness("calibrate", run, "-o", out).returncode == 2


def test_json_has_the_fit_and_its_intervals(
    flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path
) -> None:
    done = harness("calibrate", flown[0], "-o", tmp_path / "fitted.yaml", "--json")
    result = json.loads(done.stdout)

    assert result["messages"] == len(flown[1].attempts)
    low, high = result["fit"]["range_m"]["interval"]
    assert low < result["fit"]["range_m"]["value"] < high
    assert result["exponent"] == {"value": 2.32, "interval": None, "assumed": True}
    assert result["validation"]["log_score"] < result["validation"]["constant_log_score"]


def test_flight_at_one_distance_gets_one_loss(
    tmp_path: Path, flown: tuple[Path, CalibrationResult, DeliveryModel]
) -> None:
    shutil.copytree(flown[0], tmp_path / "run")
    tracks = tmp_path / "run" / "tracks.jsonl"
    lines = [json.loads(line) for line in tracks.read_text().splitlines()]
    for line in lines:
        line["places"] = {vehicle: [0.0, float(int(vehicle) % 2), 0.0] for vehicle in line["places"]}
    tracks.write_text("".join(json.dumps(line) + "\n" for line in lines))
    calibration = calibrate([tmp_path / "run"])

    assert calibration.fit is None
    assert [*calibration.network()] == ["loss"]
    assert any("the range cannot be estimated" in sentence for sentence in calibration.sentences())


def test_channel_has_the_fitted_range(flown: tuple[Path, CalibrationResult, DeliveryModel], tmp_path: Path) -> None:
    out = tmp_path / "fitted.yaml"
    assert harness("calibrate", flown[0], "-o", out, "--channel", "lora_sf7").returncode == 0
    network = load_scenario(out).network
    assert network.channel is not None
    radio = network.channel.radio()
    figures = radio.exponent, radio.shadowing_db, radio.power_dbm, radio.sensitivity_dbm, radio.frequency_hz
    assert flown[1].fit is not None
    assert model_of(LogDistance(*figures)).range_m == pytest.approx(flown[1].fit.model.range_m, rel=1e-3)
    refused = harness("calibrate", flown[0], "-o", tmp_path / "other.yaml", "--channel", "wifi")
    assert refused.returncode == 2
    assert "'wifi' is not one of 'wifi_1'" in refused.stderr

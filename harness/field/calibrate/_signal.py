"""Estimate the path loss exponent from the signal strengths that telemetry radios reported (RADIO_STATUS).

The module assumes that the ground station is at the place where the vehicle took off. The signal strength falls by 10 *
exponent dB when the distance grows by a factor of ten. The unit of SiK radios is 1.9 counts per dB (SiK,
Firmware/radio/radio.c). The interval comes from the jackknife over minutes, because neighbouring samples have the same
shadowing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from harness.field.calibrate._delivery_model import ConfidenceInterval, student
from harness.field.calibrate._positions import Positions

_COUNTS_PER_DB = 1.9
_MIN_SAMPLES, _MIN_MINUTES, _MIN_RATIO = 30, 4, 3.0
_MIN_DISTANCE_M = 10.0
_PLAUSIBLE = (1.0, 6.0)
_METRES_PER_DEGREE = 111_195.0

Sample = tuple[float, float, int]
"""A signal strength measurement: ln(distance), signal strength in dB, and the index of the minute in which it was
measured.
"""


@dataclass(frozen=True)
class SignalFit:
    """The estimated path loss exponent with its confidence interval, from `samples` signal strengths."""

    exponent: float
    interval: ConfidenceInterval
    samples: int


def fit_signal(positions: Positions) -> SignalFit | None:
    """Estimate the path loss exponent from the signal strengths in all logs. Return None if the logs do not determine
    it.
    """
    samples = [sample for number, log in enumerate(positions.logs) for sample in _samples(positions, number)]
    minutes = sorted({minute for _, _, minute in samples})
    if len(samples) < _MIN_SAMPLES or len(minutes) < _MIN_MINUTES:
        return None
    if max(samples)[0] - min(samples)[0] < math.log(_MIN_RATIO):
        return None
    slope = _exponent(samples)
    without = [_exponent([sample for sample in samples if sample[2] != minute]) for minute in minutes]
    variance = sum((each - slope) ** 2 for each in without) * (len(minutes) - 1) / len(minutes)
    half = student(len(minutes) - 1) * math.sqrt(variance)
    if not _PLAUSIBLE[0] <= slope <= _PLAUSIBLE[1]:
        return None
    return SignalFit(slope, ConfidenceInterval(slope - half, slope + half), len(samples))


def _samples(positions: Positions, number: int) -> list[Sample]:
    log = positions.logs[number]
    if len(log.vehicles) != 1 or not (track := log.vehicles[0].positions):
        return []
    home, place, samples = track[0], 0, []
    for status in log.radio:
        while place + 1 < len(track) and track[place + 1].at_us <= status.at_us:
            place += 1
        position = track[place]
        if not status.rssi or abs(position.at_us - status.at_us) > 2_000_000:
            continue
        distance_m = math.hypot(
            (position.lat_deg - home.lat_deg) * _METRES_PER_DEGREE,
            (position.lon_deg - home.lon_deg) * _METRES_PER_DEGREE * math.cos(math.radians(home.lat_deg)),
            position.alt_m - home.alt_m,
        )
        if distance_m >= _MIN_DISTANCE_M:
            minute = number * 1_000_000 + status.at_us // 60_000_000 % 1_000_000
            samples.append((math.log(distance_m), status.rssi / _COUNTS_PER_DB, minute))
    return samples


def _exponent(samples: Sequence[Sample]) -> float:
    mean_x = sum(x for x, _, _ in samples) / len(samples)
    mean_y = sum(y for _, y, _ in samples) / len(samples)
    slope = sum((x - mean_x) * (y - mean_y) for x, y, _ in samples) / sum((x - mean_x) ** 2 for x, _, _ in samples)
    return -slope * math.log(10) / 10

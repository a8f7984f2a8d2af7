"""Define the properties of radios: power, reception, the form of frames, and the rule for access to the channel.

Each kind of radio is a class. Its fields are the keys of `network.channel` in a scenario, with the unit in the name. In
this module times are seconds. The model of the channel uses whole nanoseconds, because it must recognise equal times.
For example, two stations collide if they start in the same slot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

from netem.errors import ConditionsError

Ground = Literal["none", "two_ray"]

NANOSECONDS = 1_000_000_000
MAX_S = 3600.0
MAX_BYTES = 65_507
"""Maximum number of data bytes in a UDP datagram."""


@dataclass(frozen=True, kw_only=True)
class Radio:
    """The properties that all kinds of radio have."""

    power_dbm: float
    sensitivity_dbm: float
    noise_dbm: float
    preamble_db: float
    sinr_db: float
    capture_window_s: float
    frequency_hz: float
    exponent: float = 2.32
    shadowing_db: float = 3.0
    shadowing_m: float = 37.0
    shadowing_s: float = 60.0
    ground: Ground = "none"
    antenna_m: float = 0.5
    header_bytes: int
    largest_bytes: int
    queue_frames: int = 10

    def __post_init__(self) -> None:
        for field in fields(self):
            _check(field.name, getattr(self, field.name))

    def airtime_ns(self, data_bytes: int) -> int:
        """Return how long a message with this number of data bytes occupies the channel, in nanoseconds."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class WifiRadio(Radio):
    """An IEEE 802.11 radio for broadcasts. It has carrier sense and random waiting times, and no acknowledgements or
    retries.
    """

    rate_bps: float
    preamble_s: float
    symbol_s: float
    padding_bits: int
    extension_s: float = 0.0
    slot_s: float
    difs_s: float
    eifs_s: float
    contention_window: int
    sense_s: float
    energy_dbm: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.eifs_s < self.difs_s:
            raise ConditionsError(
                f"channel.eifs_s: {self.eifs_s!r} is below difs_s, {self.difs_s!r}; allowed is difs_s or more"
            )

    def airtime_ns(self, data_bytes: int) -> int:
        bits = 8 * (self.header_bytes + data_bytes) + self.padding_bits
        symbols = math.ceil(round(bits / (self.rate_bps * self.symbol_s), 6))
        return nanoseconds(self.preamble_s) + symbols * nanoseconds(self.symbol_s) + nanoseconds(self.extension_s)


@dataclass(frozen=True, kw_only=True)
class TimeSlotRadio(Radio):
    """A telemetry radio with time slots. The vehicles send one after another, each vehicle in its own time slot."""

    rate_bps: float
    preamble_s: float
    turn_s: float
    guard_s: float
    duty: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.turn_s <= self.guard_s:
            raise ConditionsError(
                f"channel.turn_s: {self.turn_s!r} is not above guard_s, {self.guard_s!r}; allowed is a longer turn"
            )

    def airtime_ns(self, data_bytes: int) -> int:
        bits = 8 * (self.header_bytes + data_bytes)
        return nanoseconds(self.preamble_s) + round(NANOSECONDS * bits / self.rate_bps)


@dataclass(frozen=True, kw_only=True)
class LoraRadio(Radio):
    """A LoRa radio. It sends immediately and without carrier sense, unless its duty cycle does not allow this."""

    spreading_factor: int
    bandwidth_hz: float
    coding_rate: int
    preamble_symbols: int
    duty: float

    def airtime_ns(self, data_bytes: int) -> int:
        """Return the sending time in nanoseconds with explicit header and CRC (Semtech, SX1276 data sheet, rev. 7,
        4.1.1.6 and 4.1.1.7).

        The low data rate optimisation is on if a symbol is longer than 16 ms, as the data sheet demands.
        """
        factor = self.spreading_factor
        symbol_ns = round(NANOSECONDS * (1 << factor) / self.bandwidth_hz)
        per_block = 4 * (factor - 2 * (symbol_ns > 16_000_000))
        bits = 8 * (self.header_bytes + data_bytes) - 4 * factor + 28 + 16
        payload_symbols = 8 + max(-(-bits // per_block) * self.coding_rate, 0)
        return (4 * (self.preamble_symbols + payload_symbols) + 17) * symbol_ns // 4


def nanoseconds(seconds: float) -> int:
    return round(seconds * NANOSECONDS)


_WHOLE = {
    "header_bytes": (0, MAX_BYTES),
    "largest_bytes": (1, MAX_BYTES),
    "queue_frames": (1, 100_000),
    "padding_bits": (0, 1000),
    "contention_window": (0, 65_535),
    "spreading_factor": (6, 12),
    "coding_rate": (5, 8),
    "preamble_symbols": (1, 65_535),
}
"""Key -> the least and the greatest allowed integer."""

_RANGES: dict[str, tuple[float, float]] = {
    "power_dbm": (-100.0, 100.0),
    "sensitivity_dbm": (-160.0, 100.0),
    "noise_dbm": (-180.0, 100.0),
    "energy_dbm": (-160.0, 100.0),
    "preamble_db": (0.0, 100.0),
    "sinr_db": (-50.0, 100.0),
    "shadowing_db": (0.0, 100.0),
    "shadowing_m": (0.0, 1e9),
    "shadowing_s": (0.0, 1e9),
    "antenna_m": (0.0, 1e4),
    "exponent": (0.1, 10.0),
    "frequency_hz": (1e5, 1e12),
    "bandwidth_hz": (1e3, 1e9),
    "rate_bps": (8.0, 1e10),
    "duty": (0.0001, 1.0),
    "slot_s": (1e-9, MAX_S),
    "symbol_s": (1e-9, MAX_S),
    "turn_s": (1e-9, MAX_S),
}
"""Key -> the least and the greatest allowed value. A time that is not listed may be 0 to MAX_S seconds."""


def _check(key: str, value: object) -> None:
    if key == "ground":
        if value not in ("none", "two_ray"):
            raise ConditionsError(f"channel.ground: {value!r} is unknown; allowed is none or two_ray")
        return
    whole = key in _WHOLE
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        raise ConditionsError(f"channel.{key}: {value!r} is not {'an integer' if whole else 'a number'}")
    least, greatest = _WHOLE[key] if whole else _RANGES.get(key, (0.0, MAX_S))
    if not least <= value <= greatest:
        raise ConditionsError(f"channel.{key}: {value!r} is out of range; allowed is {least:g} to {greatest:g}")

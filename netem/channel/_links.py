"""Compute the power with which each vehicle receives each other vehicle. The power depends on the path loss over the
distance and on shadowing.

Shadowing is a normally distributed deviation of the power in decibels. It is equal in both directions of a link. After
a vehicle has moved, or after some time, the deviation is new, but a part of the old deviation remains (Gudmundson,
Correlation Model for Shadow Fading in Mobile Radio Systems, Electronics Letters 27(23), 1991). If both ends of a link
move, both movements change the shadowing (Wang, Tameh, Nix, Joint Shadowing Process in Urban Peer-to-Peer Radio
Channels, IEEE Transactions on Vehicular Technology 57(1), 2008). Links are independent of each other, even if two
vehicles fly side by side, because the model has no map of obstacles.

Powers are whole multiples of 0.01 dB. To add powers, the module converts them to linear values with a table. The
results are therefore equal on all machines.
"""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from operator import add
from random import Random

from netem._distributions import SCALE, table
from netem.channel._parameters import NANOSECONDS, Radio, nanoseconds
from netem.radio import MIN_DISTANCE_M, Place

STEP = 0.1
"""Fraction of the correlation time, and of the correlation distance, after which the shadowing is drawn again. Over the
complete time or distance, the correlation falls to 1/e. From one draw to the next, it falls to exp(-STEP), about 0.9.
"""

_SILENT = -1_000_000
"""Level in 0.01 dB at a receiver that a frame does not reach. It is so low that no shadowing makes the frame
audible.
"""

_TABLE_SIZE = 4096
_KEPT_STEPS = 1 << 16
_MANTISSA = [round(10 ** (6 + step / 1000)) for step in range(1000)]
_LIGHT_M_PER_S = 299_792_458.0


@cache
def linear(centibels: int) -> float:
    """Convert a level in 0.01 dB to a linear power. A level of 0 gives the power 10^6."""
    if centibels < _SILENT // 2:
        return 0.0
    tens, step = divmod(centibels, 1000)
    return _MANTISSA[step] * 10.0**tens if tens >= 0 else _MANTISSA[step] / 10.0**-tens


@cache
def _deviations(shadowing_db: float) -> list[int]:
    """Return values in 0.01 dB that approximate a normal distribution. Each value is equally probable."""
    return [round(100 * shadowing_db * quantile / SCALE) for quantile in table("normal", _TABLE_SIZE)]


@dataclass(slots=True)
class FrameReach:
    """The reception of one sender's frames at all receivers. A set of receivers is an integer with one bit per
    receiver. Receiver 0 is the lowest bit.
    """

    levels: list[int]
    """Received power at each receiver in 0.01 dB."""
    heard: int
    """Receivers that can receive the frame if no other frame disturbs it."""
    energetic: int
    """Receivers that sense the carrier by its energy alone."""
    faded: int
    """Receivers that do not receive the frame because of the shadowing."""
    far: int
    """Receivers that are out of range even without shadowing."""
    cut: int
    """Receivers that listen to another channel."""
    _powers: list[float] | None = None

    @property
    def powers(self) -> list[float]:
        """The linear received power at each receiver. It is computed only if frames overlap."""
        if self._powers is None:
            self._powers = [linear(level) for level in self.levels]
        return self._powers


@dataclass(slots=True)
class _MeanReach:
    """The reception of one sender's frames without shadowing."""

    levels: list[int]
    near: int
    """Receivers in range."""
    far: int
    """Receivers out of range."""
    cut: int
    """Receivers that listen to another channel."""


class RadioLinks:
    """The links between `count` vehicles. All vehicles are at the same place until `move` is called."""

    def __init__(self, count: int, radio: Radio, energy_dbm: float, draws: Random) -> None:
        self._count = count
        self._radio = radio
        self._power = _hundredths_of_db(radio.power_dbm)
        self._sensitivity = _hundredths_of_db(radio.sensitivity_dbm)
        self._energy = _hundredths_of_db(energy_dbm)
        self._each_frame = radio.shadowing_db > 0 and 0.0 in (radio.shadowing_m, radio.shadowing_s)
        self._correlated = radio.shadowing_db > 0 and not self._each_frame
        self._draws = draws
        self._deviations = _deviations(radio.shadowing_db)
        self._bits = [1 << number for number in range(count)]
        self._group = [0] * count
        self._places = [Place(0.0, 0.0, 0.0)] * count
        self._first_metre_db = 20 * math.log10(4 * math.pi * MIN_DISTANCE_M * radio.frequency_hz / _LIGHT_M_PER_S)
        self._means: list[_MeanReach | None] = [None] * count
        """The reception without shadowing for each sender. It is computed when the vehicle first sends."""
        self._moved_m = [0.0] * count
        """Metres that each vehicle has moved since the last change of the shadowing."""
        self._shadow = [[0] * count for _ in range(count)]
        self._shadowed_at = 0
        self._ages_at = 0
        self._reaches: list[FrameReach | None] = [None] * count
        if self._correlated:
            self._ages_at = nanoseconds(STEP * radio.shadowing_s)
            self._shift(None)

    def move(self, places: Sequence[Place]) -> None:
        """Set the positions of the vehicles."""
        moved = [number for number, place in enumerate(places) if place != self._places[number]]
        if not moved:
            return
        for number in moved:
            self._moved_m[number] += places[number].distance_m(self._places[number])
        if self._correlated and 2 * max(self._moved_m) > STEP * self._radio.shadowing_m:
            self._ages_at = 0
        self._places = list(places)
        self._forget()

    def tune(self, groups: Sequence[int]) -> None:
        """Set the group of each vehicle. Only vehicles of the same group affect each other."""
        self._group = list(groups)
        self._forget()

    def _forget(self) -> None:
        self._means = [None] * self._count
        self._reaches = [None] * self._count

    def reach(self, sender: int, now_ns: int) -> FrameReach:
        """Return the reception of a frame that `sender` begins to send now."""
        if self._each_frame:
            return self._computed(sender, self._drawn(self._count))
        if self._correlated and now_ns >= self._ages_at:
            self._age(now_ns)
        found = self._reaches[sender]
        if found is None:
            found = self._reaches[sender] = self._computed(sender, self._shadow[sender])
        return found

    def _computed(self, sender: int, shadow: Sequence[int]) -> FrameReach:
        mean = self._means[sender]
        if mean is None:
            mean = self._means[sender] = self._mean(sender)
        levels = list(map(add, mean.levels, shadow))
        sensitivity, energy = self._sensitivity, self._energy
        heard = energetic = 0
        for bit, level in zip(self._bits, levels, strict=True):
            if level >= sensitivity:
                heard |= bit
            if level >= energy:
                energetic |= bit
        return FrameReach(levels, heard, energetic, mean.near & ~heard, mean.far & ~heard, mean.cut)

    def _mean(self, sender: int) -> _MeanReach:
        levels = [_SILENT] * self._count
        near = far = cut = 0
        for receiver, bit in enumerate(self._bits):
            if receiver == sender:
                continue
            if self._group[receiver] != self._group[sender]:
                cut |= bit
                continue
            level = levels[receiver] = self._power - self._path_loss(self._places[sender], self._places[receiver])
            if level >= self._sensitivity:
                near |= bit
            else:
                far |= bit
        return _MeanReach(levels, near, far, cut)

    def _path_loss(self, one: Place, other: Place) -> int:
        """Return the path loss between two places in 0.01 dB. By default, this is the path loss of the log-distance
        model. With the ground model `two_ray`, the function also computes the path loss over flat ground, and returns
        the greater of both (Rappaport, Wireless Communications, 2nd ed., eq. 4.52, far from the antennas).
        """
        radio = self._radio
        metres = max(one.distance_m(other), MIN_DISTANCE_M)
        loss_db = self._first_metre_db + 10 * radio.exponent * math.log10(metres)
        if radio.ground == "two_ray":
            heights = [max(place.up_m, 0.0) + radio.antenna_m for place in (one, other)]
            if min(heights) <= 0:
                return _hundredths_of_db(1000.0)
            loss_db = max(loss_db, 40 * math.log10(metres) - 20 * math.log10(heights[0] * heights[1]))
        return _hundredths_of_db(loss_db)

    def _age(self, now_ns: int) -> None:
        """Change the shadowing values after some time has passed. After a long time or long movements, the new values
        hardly depend on the old ones.
        """
        elapsed_s = (now_ns - self._shadowed_at) / NANOSECONDS
        self._shadowed_at = now_ns
        self._ages_at = now_ns + nanoseconds(STEP * self._radio.shadowing_s)
        self._shift(elapsed_s / self._radio.shadowing_s)

    def _shift(self, exponent: float | None) -> None:
        """Draw new shadowing values that are correlated with the old ones. The correlation is exp(-`exponent`) if no
        vehicle has moved, and smaller after movements. If `exponent` is None, the new values do not depend on the old
        ones.
        """
        shadow, moved_m = self._shadow, self._moved_m
        known = -1.0
        kept = rest = 0.0
        deviations = iter(self._drawn(self._count * (self._count - 1) // 2))
        for one, row in enumerate(shadow):
            for other in range(one):
                moved = moved_m[one] + moved_m[other]
                if moved != known:
                    known = moved
                    share = 0.0 if exponent is None else math.exp(-exponent - moved / self._radio.shadowing_m)
                    kept = round(share * _KEPT_STEPS) / _KEPT_STEPS
                    rest = math.sqrt(1 - kept * kept)
                row[other] = shadow[other][one] = round(row[other] * kept + rest * next(deviations))
        self._moved_m = [0.0] * self._count
        self._reaches = [None] * self._count

    def _drawn(self, count: int) -> list[int]:
        """Draw values of a normal distribution in 0.01 dB."""
        words = array("H", self._draws.randbytes(2 * count))
        if sys.byteorder == "big":
            words.byteswap()
        deviations = self._deviations
        return [deviations[word % _TABLE_SIZE] for word in words]


def _hundredths_of_db(decibels: float) -> int:
    return round(100 * decibels)

"""Count damaged parts of a flight log, and check whether values are plausible."""

import math
from dataclasses import dataclass

MAX_SEARCHES = 500_000
"""Maximum number of times that the reader searches for the next message in a file."""
_NO_PLACE_DEG = 0.01
_ALTITUDES_M = (-1000.0, 100_000.0)


@dataclass
class DamagedBytes:
    """A counter of the bytes in a flight log that belong to no message."""

    searches: int = 0
    skipped_bytes: int = 0
    first_at: int | None = None
    ends_at: int | None = None
    """Position of the byte at which reading stopped because of too much damage, or None if the file was read to its
    end.
    """
    unusable: int = 0
    """Number of messages with an unknown layout or impossible values."""

    def skip(self, at: int, size: int) -> None:
        self.searches += 1
        self.skipped_bytes += size
        if self.first_at is None:
            self.first_at = at

    def ends_reading(self, at: int) -> bool:
        """Return true if the damage before the position `at` is so large that reading must stop."""
        if self.searches <= MAX_SEARCHES:
            return False
        self.ends_at = at
        return True

    def sentences(self) -> list[str]:
        """Return a sentence for each kind of damage in a flight log."""
        sentences = []
        if self.skipped_bytes:
            sentences.append(
                f"{self.skipped_bytes:,} bytes are no whole message and are skipped, first at byte {self.first_at:,}"
            )
        if self.ends_at is not None:
            sentences.append(f"the part after byte {self.ends_at:,} is not read, because the file has too much damage")
        if self.unusable:
            messages = "1 message has" if self.unusable == 1 else f"{self.unusable:,} messages have"
            sentences.append(f"{messages} an unknown layout or impossible values and are left out")
        return sentences


def is_place(lat_deg: float, lon_deg: float, alt_m: float) -> bool:
    """Return true if these values are a position on Earth.

    A place near 0° N, 0° E does not count, because vehicles report it while they do not know their position.
    """
    return (
        -90 <= lat_deg <= 90
        and -180 <= lon_deg <= 180
        and _ALTITUDES_M[0] <= alt_m <= _ALTITUDES_M[1]
        and math.hypot(lat_deg, lon_deg) > _NO_PLACE_DEG
    )

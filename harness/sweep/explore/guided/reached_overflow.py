"""What a long hunt reaches once `harness.proof.coverage.Reached` is full: told apart in memory that does not grow."""

BITS = 1 << 28
"""32 MiB. Of ten million numbers one in thirty is taken for another that was there before."""


class Beyond:
    """Numbers of local states, or of pairs, which are digests. `count` is how many there are, at least."""

    def __init__(self) -> None:
        self.count = 0
        self._bits = bytearray(BITS // 8)

    def __contains__(self, number: int) -> bool:
        place = number % BITS
        return bool(self._bits[place >> 3] >> (place & 7) & 1)

    def add(self, number: int) -> None:
        """Take down one that is not there."""
        place = number % BITS
        self._bits[place >> 3] |= 1 << (place & 7)
        self.count += 1

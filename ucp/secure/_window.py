"""The sequence numbers that a receiver has accepted from a sender: the sliding window of RFC 6479.

The window is a ring of machine words. It has one word more than its size requires. To move the window, the receiver
clears whole words and never shifts bits.
"""

WINDOW = 1024
"""Number of sequence numbers in the window, including the newest one. Older datagrams are rejected."""
_WORD_BITS = 64
_WORDS = WINDOW // _WORD_BITS + 1


class ReplayWindow:
    """The replay window of one incarnation of one sender. It accepts sequence numbers from `first` on.

    The caller accepts only sequence numbers of authentic datagrams.
    """

    __slots__ = ("_newest", "_words")

    def __init__(self, first: int = 0) -> None:
        self._newest = first - 1
        self._words = [2**_WORD_BITS - 1 if first else 0] * _WORDS

    def is_fresh(self, sequence: int) -> bool:
        """Return whether this sequence number is inside or above the window, and was not accepted before."""
        if sequence > self._newest:
            return True
        if sequence <= self._newest - WINDOW:
            return False
        return not self._words[sequence // _WORD_BITS % _WORDS] >> sequence % _WORD_BITS & 1

    def accept(self, sequence: int) -> None:
        """Record a sequence number as accepted. `is_fresh(sequence)` must be true."""
        word = sequence // _WORD_BITS
        newest_word = self._newest // _WORD_BITS
        if sequence > self._newest:
            for passed in range(min(word - newest_word, _WORDS)):
                self._words[(word - passed) % _WORDS] = 0
            self._newest = sequence
        self._words[word % _WORDS] |= 1 << sequence % _WORD_BITS

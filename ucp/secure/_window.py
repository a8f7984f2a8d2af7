"""Which of a sender's sequence numbers have come: the sliding window of RFC 6479.

A ring of words with one more than the window needs: it moves on by clearing whole words, and never shifts a bit.
"""

WINDOW = 1024
"""How far behind the newest sequence number one may be and still count."""
_WORD_BITS = 64
_WORDS = WINDOW // _WORD_BITS + 1


class ReplayWindow:
    """Of one sender's one life. Only what proved authentic is `accept`ed."""

    __slots__ = ("_newest", "_words")

    def __init__(self) -> None:
        self._newest = -1
        self._words = [0] * _WORDS

    def is_fresh(self, sequence: int) -> bool:
        """Whether it has not come yet, and is not so old that nobody knows."""
        if sequence > self._newest:
            return True
        if sequence <= self._newest - WINDOW:
            return False
        return not self._words[sequence // _WORD_BITS % _WORDS] >> sequence % _WORD_BITS & 1

    def accept(self, sequence: int) -> None:
        """It has come; it `is_fresh`."""
        word = sequence // _WORD_BITS
        newest_word = self._newest // _WORD_BITS
        if sequence > self._newest:
            for passed in range(min(word - newest_word, _WORDS)):
                self._words[(word - passed) % _WORDS] = 0
            self._newest = sequence
        self._words[word % _WORDS] |= 1 << sequence % _WORD_BITS

"""Divide a byte stream into MAVLink frames without decoding them, which is fast."""

from __future__ import annotations

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_HEADER_BYTES = 3  # bytes that determine the length of a frame


class FrameSplitter:
    """A splitter that divides the bytes of one vehicle into frames, and skips all other bytes."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Add bytes to the stream. Return the frames that are now complete. The splitter stores less than one frame,
        which has at most 292 bytes.
        """
        stream, at, frames = self._rest + data, 0, []
        while len(stream) - at >= _HEADER_BYTES:
            length = _length(stream, at)
            if length is None:
                at += 1
            elif len(stream) - at < length:
                break
            else:
                frames.append(stream[at : at + length])
                at += length
        self._rest = stream[at:]
        return frames


def _length(stream: bytes, at: int) -> int | None:
    """Return the length of the frame that begins at position `at` of the stream. Return None if no frame begins at this
    position, or if the length is not known yet.
    """
    if stream[at] == _V2:
        return 12 + stream[at + 1] + 13 * (stream[at + 2] & _SIGNED)
    return 8 + stream[at + 1] if stream[at] == _V1 else None

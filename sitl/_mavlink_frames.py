"""MAVLink frames of a stream, without a look into them: as fast as they come, of any dialect."""

from __future__ import annotations

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_HEADER_BYTES = 3  # what it takes to know how long a frame is


class FrameSplitter:
    """Splits what one vehicle sends into whole frames; bytes that begin no frame are skipped."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that end in these bytes. Keeps less than one frame: at most 292 bytes."""
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
    """Of the frame that begins here: header, payload, checksum, and of a signed one 13 bytes more."""
    if stream[at] == _V2:
        return 12 + stream[at + 1] + 13 * (stream[at + 2] & _SIGNED)
    return 8 + stream[at + 1] if stream[at] == _V1 else None

"""Sequence numbers of what the rogue node forges, which tell from which injection it is."""

FORGED_FROM = 1 << 31
"""No agent counts its datagrams up to this; from here on they are the rogue's."""
_EACH = 1 << 17
"""Of one injection: more than a flood has datagrams."""


def forged_sequence(injection: int, count: int) -> int:
    """That of the datagram with this count, from 0, of the injection with this number, from 1."""
    return FORGED_FROM + (injection - 1) * _EACH + count % _EACH


def injection_of(sequence: int) -> int | None:
    """The number of the injection that forged the datagram; None if an agent sent it."""
    return (sequence - FORGED_FROM) // _EACH + 1 if sequence >= FORGED_FROM else None

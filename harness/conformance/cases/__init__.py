"""Test cases that are written by hand, for behaviour that the generated tests do not cover.

Each case starts its own agents and simulates their peers (`_bench`). The modules of this package cover hostile
datagrams, blocks and votes, start and end of the program, the disk, records, and missions with keys.
"""

from harness.conformance.cases import (  # noqa: F401  (each module adds its cases to ALL)
    _block_cases,
    _datagram_cases,
    _disk_cases,
    _program_cases,
    _record_cases,
    _secured_cases,
)
from harness.conformance.cases._bench import ALL_CASES, CaseBench, HandwrittenCase

__all__ = ["ALL_CASES", "CaseBench", "HandwrittenCase"]

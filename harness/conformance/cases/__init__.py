"""Cases written by hand: what no state explains.

_bench.py      what a case is, and what it works with: an agent of its own, and what its peers say and hear
_datagram_cases.py  malformed and hostile ones, floods
_block_cases.py     how events become blocks; what one vote leaves for the next
_program_cases.py    start, end, wrong missions, the control socket
_disk_cases.py       a full disk, kill and reboot
_secured_cases.py    missions with keys
"""

from harness.conformance.cases import (  # noqa: F401  (each module adds its cases to ALL)
    _block_cases,
    _datagram_cases,
    _disk_cases,
    _program_cases,
    _secured_cases,
)
from harness.conformance.cases._bench import ALL, Bench, ByHand

__all__ = ["ALL", "Bench", "ByHand"]

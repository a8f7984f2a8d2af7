"""Cases written by hand: what no state explains.

bench.py      what a case is, and what it works with: an agent of its own, and what its peers say and hear
datagram_cases.py  malformed and hostile ones, floods
block_cases.py     how events become blocks; what one vote leaves for the next
program_cases.py    start, end, wrong missions, the control socket
disk_cases.py       a full disk, kill and reboot
secured_cases.py    missions with keys
"""

from harness.conformance.cases import block_cases, datagram_cases, disk_cases, program_cases, secured_cases
from harness.conformance.cases.bench import ALL, Bench, ByHand

__all__ = ["ALL", "Bench", "ByHand", "block_cases", "datagram_cases", "disk_cases", "program_cases", "secured_cases"]

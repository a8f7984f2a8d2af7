"""Cases written by hand: what no state explains.

bench.py      what a case is, and what it works with: an agent of its own, and what its peers say and hear
datagrams.py  malformed and hostile ones, floods
blocks.py     how events become blocks; what one vote leaves for the next
program.py    start, end, wrong missions, the control socket
disk.py       a full disk, kill and reboot
secured.py    missions with keys
"""

from harness.conformance.cases import blocks, datagrams, disk, program, secured
from harness.conformance.cases.bench import ALL, Bench, ByHand

__all__ = ["ALL", "Bench", "ByHand", "blocks", "datagrams", "disk", "program", "secured"]

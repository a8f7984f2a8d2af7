"""Preserve the floating point and vector registers of programs in User Mode Linux on any x86-64 processor.

A User Mode Linux kernel older than 6.13 (Debian 12 has 6.1) supports registers up to AVX. On newer processors this
kernel fails in two ways:

- It has 2,696 bytes for the registers of a process. On processors with AMX (Intel since Sapphire Rapids) the registers
  take 11,008 bytes, and the host transfers either all of them or none. The kernel panics at its start.
- When it delivers a signal, it saves only 832 bytes of the registers. After the signal handler, the additional
  registers of AVX-512 keep the values that the handler wrote. The C library copies memory through these registers, also
  inside handlers. Copies therefore become corrupt.

On these processors the harness preloads a library, uml_registers.c, which replaces ptrace(2). It compiles the library
at each start of User Mode Linux, because machines differ and no files should remain. The compilation takes a tenth of a
second.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from netem.errors import UmlError

SOURCE = Path(__file__).with_name("uml_registers.c")
FORCE = "UCP_UML_REGISTERS"
"""Environment variable that makes the harness preload the library even on a processor that does not need the library.
On such a processor, programs behave the same with and without the library.
"""

_FIXED_IN = (6, 13)
_FLAGS = {"avx512f", "amx_tile"}
_COMPILE = ("cc", "-O2", "-shared", "-fPIC", "-ffreestanding", "-nostdlib")


def needed(kernel: Path | None) -> bool:
    """Return true if User Mode Linux needs the library on this processor. A new enough kernel does not need it. If
    `kernel` is None, its version is not considered.
    """
    if os.environ.get(FORCE):
        return True
    if _FLAGS.isdisjoint(Path("/proc/cpuinfo").read_text().split()):
        return False
    if kernel is None:
        return True
    text = subprocess.run([kernel, "--version"], capture_output=True, text=True, errors="replace", check=False).stdout
    version = re.match(r"(\d+)\.(\d+)", text)
    return version is None or (int(version[1]), int(version[2])) < _FIXED_IN


def has_compiler() -> bool:
    """Return true if the library can be compiled on this machine."""
    return shutil.which(_COMPILE[0]) is not None


def preload(folder: Path) -> dict[str, str]:
    """Compile the library into `folder`. Return the environment variables that the kernel needs at its start to load
    the library. Raises UmlError.
    """
    library = folder / "registers.so"
    done = subprocess.run(
        [*_COMPILE, "-o", library, SOURCE], capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode != 0:
        word = (done.stderr.strip().splitlines() or [f"it ended with status {done.returncode}"])[-1]
        raise UmlError(
            f"User Mode Linux needs a library to keep this processor's registers, which cc could not compile ({word}); "
            "repair the compiler (Debian, Ubuntu: apt install --reinstall gcc)"
        )
    # A relative path, because the folder's may contain spaces and colons, which separate the entries of this list.
    return {"LD_PRELOAD": ":".join(filter(None, [f"./{library.name}", os.environ.get("LD_PRELOAD")]))}

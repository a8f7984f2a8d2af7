"""What lets programs in User Mode Linux keep their floating point and vector registers, on any x86-64 processor.

A kernel older than 6.13 (Debian 12 has 6.1) knows registers up to AVX. On newer processors it falls short twice:

- It has 2,696 bytes for the state of a process, which is 11,008 with AMX (Intel since Sapphire Rapids), and the host
  takes a state only whole: it panics as it boots.
- It puts 832 bytes of the state into the frame of a signal. What AVX-512 has beyond them is after the signal as its
  handler left it. The C library copies memory with it, in handlers too: copies came out wrong.

There a library is preloaded into it, uml_registers.c, that does better than its ptrace(2). It is compiled for each
guest, in a tenth of a second, as machines differ and nothing should be left behind.
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
"""With this variable set, the library is preloaded on any processor: there it keeps what would be kept without it."""

_MENDED = (6, 13)
_FLAGS = {"avx512f", "amx_tile"}
_COMPILE = ("cc", "-O2", "-shared", "-fPIC", "-ffreestanding", "-nostdlib")


def needed(kernel: Path | None) -> bool:
    """Whether this processor has registers that this User Mode Linux would not keep by itself; None: any of today's."""
    if os.environ.get(FORCE):
        return True
    if _FLAGS.isdisjoint(Path("/proc/cpuinfo").read_text().split()):
        return False
    if kernel is None:
        return True
    text = subprocess.run([kernel, "--version"], capture_output=True, text=True, errors="replace", check=False).stdout
    version = re.match(r"(\d+)\.(\d+)", text)
    return version is None or (int(version[1]), int(version[2])) < _MENDED


def has_compiler() -> bool:
    """Whether the library can be made here."""
    return shutil.which(_COMPILE[0]) is not None


def preload(folder: Path) -> dict[str, str]:
    """Compile the library into `folder`; the variables of a kernel that is started there. Raises UmlError."""
    library = folder / "registers.so"
    done = subprocess.run(
        [*_COMPILE, "-o", library, SOURCE], capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode != 0:
        word = (done.stderr.strip().splitlines() or [f"it ended with status {done.returncode}"])[-1]
        raise UmlError(
            f"User Mode Linux needs a library to keep this processor's registers, which cc could not compile ({word}); "
            "mend the compiler (Debian, Ubuntu: apt install --reinstall gcc)"
        )
    # A relative path, for the folder's may have spaces and colons, which part the paths of this list.
    return {"LD_PRELOAD": ":".join(filter(None, [f"./{library.name}", os.environ.get("LD_PRELOAD")]))}

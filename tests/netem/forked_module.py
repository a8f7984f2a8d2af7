"""Print facts about the forked process, and end in the way that the first argument names."""

import os
import resource
import sys
from pathlib import Path


def main() -> None:
    files = sorted(entry.name for entry in Path("/proc/self/fd").iterdir())
    limit, network = resource.getrlimit(resource.RLIMIT_FSIZE)[0], Path("/proc/self/ns/net").readlink()
    found = (*sys.argv[1:], Path.cwd(), dict(os.environ), files, os.getsid(0) == os.getpid(), limit, network)
    sys.stdout.writelines(f"{fact}\n" for fact in found)
    if sys.argv[1] == "fail":
        sys.exit("one sentence")
    if sys.argv[1] == "crash":
        raise ValueError("unexpected")

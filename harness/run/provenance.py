"""Record the versions of the software that ran and judged a scenario. Result files contain them under the key
`versions`.
"""

import hashlib
import platform
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path

from harness import compiled
from harness.checker import reference
from harness.play.core_version import core_version
from harness.play.variant import variant_in_use
from netem import uml

PACKAGES = ("ucp-harness", "pymavlink")
ROOT = Path(__file__).parents[2]
GIT_LIMIT_S = 5.0


def versions() -> dict[str, str]:
    """Return the versions of agent core, reference, variant, packages, Python, kernel and platform.

    The key `commit` exists if the harness runs from a git clone. A commit that ends in "-dirty" means that files of the
    clone were modified.
    """
    commit = _commit()
    return {
        **{package: version(package) for package in PACKAGES},
        **({"commit": commit} if commit else {}),
        "core": core_version(),
        "reference": _reference_version(),
        "modules": compiled.in_use,
        **({"variant": variant.version} if (variant := variant_in_use()) is not None else {}),
        "python": platform.python_version(),
        "kernel": f"{platform.release()} (User Mode Linux)" if uml.inside() else platform.release(),
        "platform": sys.platform,
    }


JUDGE = ("ucp-harness", "commit", "reference")
"""The keys of `versions` that identify the code of the checker."""
MODIFIED = "-dirty"


def same_judge(recorded: Mapping[str, str]) -> bool:
    """Return true if the installed checker judged the run: its versions equal the recorded ones, and its code is
    unmodified.
    """
    present = versions()
    return not present.get("commit", "").endswith(MODIFIED) and all(
        recorded.get(key) == present.get(key) for key in JUDGE
    )


def differing_versions(a: Mapping[str, str], b: Mapping[str, str]) -> list[str]:
    """Compare the versions in two records. Return a text for each version that differs, such as "core x and y"."""
    return [
        f"{key} {a.get(key, 'unknown')} and {b.get(key, 'unknown')}"
        for key in ("ucp-harness", "commit", "core", "reference")
        if a.get(key) != b.get(key)
    ]


@cache
def _reference_version() -> str:
    """Return a digest of the reference implementation, with which the checker compares handler runs."""
    files = sorted(Path(reference.__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


@cache
def _commit() -> str | None:
    """Return the git commit of the running harness. Return None for an installed package."""
    if not (ROOT / ".git").exists():
        return None
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=GIT_LIMIT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip() or None

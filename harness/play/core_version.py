"""Find out whether the agent core in use is the released core or was edited.

The core is the code of `ucp` that determines how an agent behaves. An engineer who develops the protocol edits this
code in place. An edited core has two effects. First, a run records which core its agents had. Second, virtual time
omits messages that the released core would ignore (`ucp.interest`). With an edited core, it delivers them, because an
edited core might not ignore them.

`released_core.sha256` has the digests of the released files, in the format of sha256sum(1). After a reviewed change:

    python -m harness.play.core_version --record
"""

import hashlib
import sys
from functools import cache
from pathlib import Path

import ucp

FILES = (
    "_dataclass",
    "agent",
    "_answer_spread",
    "block",
    "chain",
    "commit",
    "core",
    "events",
    "handler",
    "interest",
    "messages",
    "plain_file",
    "reconcile",
    "sealed",
    "settings",
    "short_value",
    "state",
    "store",
    "timers",
    "trace",
    "trigger",
    "wire",
)
"""The modules of the agent core, which are the modules that `ucp.agent` and `ucp.interest` import."""
RELEASED = Path(__file__).with_name("released_core.sha256")


CORE = Path(ucp.__file__).parent


@cache
def edited_files(core: Path = CORE) -> tuple[str, ...]:
    """Return the files of the agent core that differ from the released files, such as "ucp/commit.py"."""
    released: dict[str, str] = {}
    for line in RELEASED.read_text("ascii").splitlines():
        digest, name = line.split()
        released[name] = digest
    return tuple(name for name, digest in _digests(core).items() if released.get(name) != digest)


def core_version() -> str:
    """Return the version of the agent core: "released" or "edited", a digest of the core, and the names of edited
    files.
    """
    digest = hashlib.sha256("".join(_digests().values()).encode("ascii")).hexdigest()[:12]
    edited = edited_files()
    return f"edited {digest} ({', '.join(edited)})" if edited else f"released {digest}"


@cache
def _digests(core: Path = CORE) -> dict[str, str]:
    """Return the SHA-256 of each file of the agent core in hexadecimal. A missing file counts as empty."""
    paths = {f"ucp/{name}.py": core / f"{name}.py" for name in FILES}
    contents = {name: path.read_bytes() if path.is_file() else b"" for name, path in paths.items()}
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


def record() -> None:
    """Record the current agent core as the released core, by storing the digests of its files."""
    RELEASED.write_text("".join(f"{digest}  {name}\n" for name, digest in _digests().items()), "ascii")


if __name__ == "__main__":
    if sys.argv[1:] != ["--record"]:
        raise SystemExit("usage: python -m harness.play.core_version --record")
    record()

"""Fuzz target: the signed export of a secured run, or its public keys.

The checker judges both files without an unexpected exception. The first byte of the input selects a file. The other
bytes replace the content of this file.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.directory import PUBLIC_KEYS_FILE
from harness.errors import HarnessError
from tests.fuzz.finding import require, sound
from tests.harness.field.flights import flown as fly
from ucp.secure.bundle import KeySet
from ucp.secure.sealing import Depot, NotOpenedError

NAMES = ("agents/1.chain.json", PUBLIC_KEYS_FILE)
_KEYS = KeySet.derived(bytes(32), [1], seals=True)


@cache
def _place() -> TemporaryDirectory[str]:
    """Return a temporary directory that exists until the end of the process."""
    return TemporaryDirectory(prefix="fuzz-")


@cache
def _run() -> Path:
    return fly(Path(_place().name) / "run", duration_s=60.0, events={"mean_s": 5}, security={"seal": True})


def run(data: bytes) -> None:
    path = _run() / NAMES[data[0] % len(NAMES) if data else 0]
    whole = path.read_bytes()
    try:
        path.write_bytes(data[1:])
        _judge(_run(), path.name, whole == data[1:])
    finally:
        path.write_bytes(whole)
    try:
        Depot(_KEYS.public.mission, _KEYS.depot or b"").open(data, 1, 1)
    except NotOpenedError as error:
        sound(str(error))


def _judge(directory: Path, name: str, is_whole: bool) -> None:
    try:
        result = checker.check(checker.gather(RunArchive(directory)))
    except HarnessError as error:
        sound(str(error))
        return
    for sentence in (*result.errors, *(judgement.reason for judgement in result.judgements.values())):
        sound(sentence)
    require(not is_whole or not result.bad, f"the sound run is bad with its own {name}")


def seeds(flown: Path) -> Iterator[bytes]:
    for number, name in enumerate(NAMES):
        yield bytes([number]) + (_run() / name).read_bytes()

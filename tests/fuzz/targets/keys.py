"""Fuzz target: key files (bundles, public keys, private keys, lists of excluded vehicles).

The reader refuses a file, or the writer reproduces it. The input replaces a file in a directory with valid keys. The
schema in the input selects the file. An input without a known schema can replace any file.
"""

import json
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.play.keyring.inspection import in_words, inspect
from harness.play.keyring.key_directory import KeyDirectory, KeysError, load_depot_key
from tests.fuzz.finding import require, sound
from ucp.secure.bundle import load_bundle, write_bundle
from ucp.secure.keyfile import KeyFileError

NAMES = ("7.bundle.json", "public.json", "authority.key", "depot.key", "vehicles.key", "revocation.json")
_GOOD = TemporaryDirectory(prefix="fuzz-keys-")  # the fuzzer ends without removing it


def _home() -> Path:
    """Return a directory with the keys of three vehicles, one of which is excluded."""
    home = Path(_GOOD.name) / "home"
    if not home.exists():
        made = KeyDirectory.new(home, [1, 7, 28], seals=True, epoch_s=600.0)
        made.write_bundles(home, [7])
        made.revoke([28])
    return home


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        home = Path(directory) / "home"
        shutil.copytree(_home(), home)
        path = home / _name(data)
        path.write_bytes(data)
        _read(home, path)


def _name(data: bytes) -> str:
    """Return the name of the file that the input replaces."""
    names = [name for name in NAMES if json.loads((_home() / name).read_bytes())["schema"].encode() in data] or NAMES
    return names[zlib.crc32(data) % len(names)]


def _read(home: Path, path: Path) -> None:
    """Read a key file in the same way as every command."""
    kept = KeyDirectory(home)
    for read in (lambda: inspect(path), lambda: kept.bundles(), lambda: kept.revoke([1]), lambda: load_depot_key(home)):
        try:
            document = read()
        except KeysError as error:
            sound(str(error))
            continue
        if isinstance(document, list):
            for facts in document:
                sound(in_words(facts))
    try:
        bundle = load_bundle(path)
    except KeyFileError as error:
        sound(str(error))
        return
    write_bundle(path, bundle)
    require(load_bundle(path) == bundle, "a bundle is read otherwise")


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield a key file of each kind, and also one of a later epoch."""
    for name in NAMES:
        yield (_home() / name).read_bytes()
    document = json.loads((_home() / NAMES[0]).read_bytes())
    yield json.dumps({**document, "epoch": 2**32 - 1, "depot": None}).encode()

"""Search the files of a run for any secret of the mission, in any encoding."""

import base64
import json
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.play.keyring.key_directory import KeyDirectory
from ucp.messages import MalformedDatagramError
from ucp.secure.crypto_suite import KEY_BYTES, NONCE_BYTES, expand, next_epoch_secret
from ucp.secure.envelope import CLEAR, MAGIC, VERSION, read_clear_header

_SENDER = b"UCP sender\0"
_CLEAR_START = MAGIC + bytes([VERSION])


def secrets(home: KeyDirectory, epochs: int, boots: Iterable[tuple[int, bytes]] = ()) -> dict[str, bytes]:
    """Return all secrets by name: private keys, the group secret of each epoch, and the keys derived from it."""
    documents = {name: json.loads((home.directory / name).read_text()) for name in ("authority.key", "depot.key")}
    found = {name: bytes.fromhex(document["private_key"]) for name, document in documents.items()}
    bundles, mission = home.bundles(), home.public().mission
    found |= {f"private key of {agent_id}": bundle.private_key for agent_id, bundle in bundles.items()}
    secret = next(iter(bundles.values())).group_secret
    lives = list(boots)
    for epoch in range(epochs):
        found[f"group secret of epoch {epoch}"] = secret
        for sender, boot in lives:
            info = _SENDER + mission + epoch.to_bytes(4, "big") + sender.to_bytes(4, "big") + boot
            derived = expand(secret, info, 2 * KEY_BYTES + NONCE_BYTES)
            found[f"key of {sender}, epoch {epoch}"] = derived[:KEY_BYTES]
            found[f"mask of {sender}, epoch {epoch}"] = derived[KEY_BYTES + NONCE_BYTES :]
        secret = next_epoch_secret(secret, mission)
    return found


def forms(secret: bytes) -> Iterator[bytes]:
    """Yield encoded forms of a secret: raw bytes, hexadecimal, base64, an integer, a list of numbers, and Python's
    notation.
    """
    yield secret
    yield secret.hex().encode()
    yield secret.hex().upper().encode()
    # The bytes before the secret shift its base64 form; these characters depend on the secret alone.
    for shift in range(3):
        its_own = slice(-(-4 * shift // 3), 4 * (shift + len(secret)) // 3)
        yield base64.b64encode(bytes(shift) + secret)[its_own]
        yield base64.urlsafe_b64encode(bytes(shift) + secret)[its_own]
    yield str(int.from_bytes(secret, "big")).encode()
    yield str(int.from_bytes(secret, "little")).encode()
    yield ", ".join(map(str, secret)).encode()
    yield ",".join(map(str, secret)).encode()
    yield repr(secret)[2:-1].encode()


def leaks(known: dict[str, bytes], contents: Iterable[tuple[str, bytes]]) -> list[str]:
    """Return the name of each secret that occurs in the contents, with the places where it occurs."""
    looked_for = [(name, form) for name, secret in known.items() for form in forms(secret)]
    return [f"{name} in {where}" for where, content in contents for name, form in looked_for if form in content]


def left_in(directory: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the content of each file."""
    for path in directory.rglob("*"):
        if path.is_file() and not path.is_symlink():
            yield str(path), path.read_bytes()


def boots_in(content: bytes) -> set[tuple[int, bytes]]:
    """Return the senders and their boot identifiers in the headers of encrypted datagrams of a packet capture."""
    found, start = set(), content.find(_CLEAR_START)
    while start >= 0:
        length = int.from_bytes(content[start + 12 : start + 14], "big")
        try:
            clear = read_clear_header(content[start : start + CLEAR.size + length])
            found.add((clear.sender, clear.boot))
        except MalformedDatagramError:
            pass
        start = content.find(_CLEAR_START, start + 1)
    return found

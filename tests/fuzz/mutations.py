"""Damage files at random, as real flights, careless users or attackers do. A seed determines the damage."""

import json
import random
from collections.abc import Callable
from typing import Any

Mutation = Callable[[bytes, random.Random], bytes]

MOST_DAMAGES = 4
_DEEP = 100_000
_WEIRD: list[Any] = [
    *(None, True, -1, 0, 2**31, 2**53 + 1, 2**63, 2**64, 10**400, -0.0, 1e308, 0.1, "", "7", "\ud800", "\0", "é" * 300),
    *([], {}, [[]], {"": {}}, ["a", 1], "AAA", "!!!", "====", "VUMB", "ff" * 32, "nan", "A" * 5000),
]
_RAW = (
    *("NaN", "Infinity", "-Infinity", "1e999", "9" * 5000, "0" * 5000, "01", "1.", "'a'", "undefined", "\\", '"'),
    *("[" * _DEEP, '{"a":' * _DEEP, "[" * 200 + "]" * 200, '"\\ud800"', '"\\u0000"', "{", "}", ",", ",,", "\t", "\x00"),
)
"""Texts that replace a JSON value. Python's json module would not write them."""


def flip_bits(content: bytes, chance: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 1, 3, 20))):
        if changed:
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def cut(content: bytes, chance: random.Random) -> bytes:
    place = chance.randrange(len(content) + 1)
    return content[:place] if chance.random() < 0.8 else content[place:]


def lose_a_part(content: bytes, chance: random.Random) -> bytes:
    start, end = sorted(chance.randrange(len(content) + 1) for _ in range(2))
    return content[:start] + content[end:]


def fill_with_nul(content: bytes, chance: random.Random) -> bytes:
    start = chance.randrange(len(content) + 1)
    length = chance.choice((1, 16, 512, 4096))
    return content[:start] + bytes(length) + content[start + (length if chance.random() < 0.5 else 0) :]


def insert_noise(content: bytes, chance: random.Random) -> bytes:
    place = chance.randrange(len(content) + 1)
    return content[:place] + chance.randbytes(chance.choice((1, 4, 64))) + content[place:]


def repeat_a_part(content: bytes, chance: random.Random) -> bytes:
    start, end = sorted(chance.randrange(len(content) + 1) for _ in range(2))
    place = chance.randrange(len(content) + 1)
    return content[:place] + content[start:end] + content[place:]


def set_bytes(content: bytes, chance: random.Random) -> bytes:
    """Return the file with some bytes replaced by extreme numbers. In a binary format, these bytes may be a length."""
    place = chance.randrange(len(content) + 1)
    value = chance.choice((b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x40", b"\1\0\0\0" * 2))
    return content[:place] + value + content[place + len(value) :]


def move_lines(content: bytes, chance: random.Random) -> bytes:
    """Return the file with some lines repeated, swapped, removed or joined."""
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    first, second = chance.randrange(len(lines)), chance.randrange(len(lines))
    kind = chance.randrange(5)
    if kind == 0:
        lines.insert(first, lines[second])
    elif kind == 1:
        lines[first], lines[second] = lines[second], lines[first]
    elif kind == 2:
        del lines[first]
    elif kind == 3:
        lines[first] = lines[first].rstrip(b"\r\n")
    else:
        lines.insert(first, b"\n")
    return b"".join(lines)


def of_windows(content: bytes, chance: random.Random) -> bytes:
    return b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n") if chance.random() < 0.5 else content.replace(b"\n", b"\r")


def change_a_value(content: bytes, chance: random.Random) -> bytes:
    """Return the file with one value of its JSON document changed."""
    text = content.decode("utf-8", "surrogateescape")
    lines = [text] if text.startswith("{\n") else text.splitlines(keepends=True)
    number = chance.randrange(len(lines)) if lines else 0
    try:
        document = json.loads(lines[number])
    except (ValueError, IndexError, RecursionError):
        return content
    mark = "\x01here\x01"
    if not _put(document, chance, mark):
        return content
    value = chance.choice(_RAW) if chance.random() < 0.5 else json.dumps(chance.choice(_WEIRD))
    lines[number] = json.dumps(document, separators=(",", ":")).replace(json.dumps(mark), value) + "\n"
    return "".join(lines).encode("utf-8", "surrogateescape")


def _put(document: Any, chance: random.Random, value: Any) -> bool:
    """Set a random key of the document to `value`, or remove the key. Return true on success."""
    while True:
        if isinstance(document, dict) and document:
            key = chance.choice(list(document))
        elif isinstance(document, list) and document:
            key = chance.randrange(len(document))
        else:
            return False
        if isinstance(document[key], dict | list) and document[key] and chance.random() < 0.8:
            document = document[key]
            continue
        if isinstance(document, dict) and chance.random() < 0.15:
            del document[key]
        else:
            document[key] = value
        return True


MUTATIONS: tuple[Mutation, ...] = (
    *(flip_bits, cut, lose_a_part, fill_with_nul, insert_noise, repeat_a_part, set_bytes, move_lines, of_windows),
    *(change_a_value,) * 4,
)


def damaged(content: bytes, chance: random.Random) -> bytes:
    for _ in range(chance.randint(1, MOST_DAMAGES)):
        content = chance.choice(MUTATIONS)(content, chance)
    return content

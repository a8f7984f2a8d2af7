"""Test that the file schemas.sha256 has the digest of each JSON schema, so that schemas change only on purpose."""

import hashlib
from pathlib import Path

from jsonschema import Draft202012Validator

from docs.generate import json_schemas

DIGESTS = Path(__file__).with_name("schemas.sha256")
"""Lines in the format of `sha256sum`: a digest, two spaces, and a path."""

WHAT_TO_DO = """A JSON Schema has changed. To see the change, run from the top of the repository:

    git worktree add /tmp/before "$(git log -1 --format=%H -- tests/harness/schemas.sha256)"
    (cd /tmp/before && "$OLDPWD/.venv/bin/python" -m docs.generate.json_schemas /tmp/schemas-before)
    .venv/bin/python -m docs.generate.json_schemas /tmp/schemas-now
    diff -ru /tmp/schemas-before /tmp/schemas-now
    git worktree remove /tmp/before

If the change is intended, record the new digests:

    (cd /tmp/schemas-now && find * -type f | LC_ALL=C sort | xargs sha256sum) >tests/harness/schemas.sha256
"""


def test_every_schema_has_the_recorded_digest() -> None:
    texts = json_schemas.texts()
    lines = [f"{hashlib.sha256(texts[path].encode()).hexdigest()}  {path}" for path in sorted(texts)]
    assert DIGESTS.read_text(encoding="ascii").splitlines() == lines, WHAT_TO_DO


def test_every_schema_of_the_harness_is_valid() -> None:
    for name in json_schemas.MODELS:
        Draft202012Validator.check_schema(json_schemas.generate(name))


def test_program_writes_each_schema_at_its_path(tmp_path: Path) -> None:
    json_schemas.write_all(tmp_path)
    written = {path.relative_to(tmp_path).as_posix(): path.read_text() for path in tmp_path.rglob("*.json")}
    assert written == json_schemas.texts()

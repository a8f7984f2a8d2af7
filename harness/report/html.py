"""Create an HTML page that consists of one file. Its Content-Security-Policy allows only the styles and the script in
the page itself.

The template escapes every text except Markup.
"""

import base64
import hashlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any

from jinja2 import BytecodeCache, Environment, FileSystemLoader, StrictUndefined
from jinja2.bccache import Bucket
from markupsafe import Markup

from harness.present import text as words

_HERE = Path(__file__).parent
PALETTE = (_HERE / "palette.css").read_text(encoding="utf-8")
"""The colours that the report and the live page share."""
PAGE_STYLE = PALETTE + (_HERE / "page.css").read_text(encoding="utf-8")


class _TemplateCache(BytecodeCache):
    """A cache of compiled templates. It is necessary because compiling the template of a report takes longer than
    rendering it. The cache stores its files in the directory in which Python caches this module.
    """

    def _file(self, bucket: Bucket) -> Path:
        return Path(cache_from_source(str(_HERE / "html.py"))).with_name(
            f"{bucket.key}.{sys.implementation.cache_tag}.j2c"
        )

    def load_bytecode(self, bucket: Bucket) -> None:
        with suppress(OSError, EOFError, ValueError, TypeError), self._file(bucket).open("rb") as file:
            bucket.load_bytecode(file)  # a file of another template or of another Python is ignored

    def dump_bytecode(self, bucket: Bucket) -> None:
        if sys.dont_write_bytecode:
            return
        file = self._file(bucket)
        with suppress(OSError):  # as for Python's own cache, a directory that is not writable is no error
            temporary = file.with_suffix(f".{os.getpid()}.tmp")
            temporary.write_bytes(bucket.bytecode_to_string())
            temporary.replace(file)


def render(template: Path, *, styles: Sequence[str], script: str = "", **content: Any) -> str:
    """Fill in a template and return the page. The Content-Security-Policy of the page permits its styles and its script
    by their digests.
    """
    return (
        _environment(template.parent)
        .get_template(template.name)
        .render(
            styles=[Markup(style) for style in styles],  # noqa: S704 - our own text; escaping would change its digest
            style_digests=[_digest(style) for style in styles],
            script=Markup(script),  # noqa: S704 - our own text
            script_digest=_digest(script),
            **content,
        )
    )


@cache
def _environment(directory: Path) -> Environment:
    """Return a template environment for this directory. The environment caches compiled templates."""
    environment = Environment(
        loader=FileSystemLoader([directory, _HERE]),
        bytecode_cache=_TemplateCache(),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(value=words.value)
    return environment


def _digest(text: str) -> str:
    """Return the SHA-256 digest in the form that a Content-Security-Policy needs."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")

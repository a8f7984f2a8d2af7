"""A page in one file that loads nothing: its Content-Security-Policy allows its own styles and script, and no more.

Whatever a template is given is text to it, which it escapes, unless it is Markup.
"""

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from harness.present import text as words

_HERE = Path(__file__).parent
PALETTE = (_HERE / "palette.css").read_text(encoding="utf-8")
"""The colours that a report and the live page share."""
PAGE_STYLE = PALETTE + (_HERE / "page.css").read_text(encoding="utf-8")


def render(template: Path, *, styles: Sequence[str], script: str = "", **content: Any) -> str:
    """`template` fills the blocks of `base.html.j2`; a drawing in it may have one of `styles` as its own."""
    environment = Environment(
        loader=FileSystemLoader([template.parent, _HERE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(value=words.value)
    return environment.get_template(template.name).render(
        styles=[Markup(style) for style in styles],  # noqa: S704 - ours; escaped they would not be what the digests are of
        style_digests=[_digest(style) for style in styles],
        script=Markup(script),  # noqa: S704 - ours as well
        script_digest=_digest(script),
        **content,
    )


def _digest(text: str) -> str:
    """As a Content-Security-Policy names what it allows."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")

"""Add pages from outside the folder `docs/` to the documentation site.

The README is the start page of the site. Each file to which a page links becomes part of the site. Its path on the site
is its path in the repository. A link to a folder leads to the README of the folder. If the folder has no README, the
link becomes plain text. The repository does not contain the JSON schemas. This hook generates them at the paths in the
links.
"""

import os
import posixpath
import re
from collections.abc import Callable
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from docs.generate.json_schemas import texts

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
HOME = "index.md"
SCHEMAS = {ROOT / path: text for path, text in texts().items()}

_FENCED = re.compile(r"(^(?:```|~~~).*?^(?:```|~~~)$|^(?: {4,}|\t).*?$)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\]\((?P<target>[^)\s#:]+)(?P<anchor>#[^)\s]*)?\)")
_IMAGE = re.compile(r'(?P<before><img src=")(?P<target>[^":]+)')


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files to which pages link, directly or through other added pages."""
    waiting = [ROOT / "README.md", *(Path(file.abs_src_path or "") for file in files.documentation_pages())]
    there = {*waiting}
    while waiting:
        page = waiting.pop()
        for target in _targets(page):
            if target not in there and target not in SCHEMAS:
                there.add(target)
                if target.suffix == ".md":
                    waiting.append(target)
    for path in sorted(there):
        if files.get_file_from_path(_uri(path)) is None:
            files.append(File.generated(config, _uri(path), abs_src_path=str(path)))
    for path, text in SCHEMAS.items():
        files.append(File.generated(config, _uri(path), content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the text of the page with links that work on the site."""
    source = ROOT / "README.md" if page.file.src_uri == HOME else _source(page.file.src_uri)
    here = posixpath.dirname(page.file.src_uri) or "."

    def link(match: re.Match[str]) -> str:
        target = _resolved(source, match["target"])
        if target is None:
            return match["text"]
        return f"[{match['text']}]({posixpath.relpath(_uri(target), here)}{match['anchor'] or ''})"

    def image(match: re.Match[str]) -> str:
        target = _resolved(source, match["target"])
        assert target is not None, f"{source}: there is no {match['target']}"
        back = "" if page.file.src_uri == HOME else "../" if page.file.use_directory_urls else ""
        return f"{match['before']}{back}{posixpath.relpath(_uri(target), here)}"

    return _outside_of_code(markdown, lambda text: _IMAGE.sub(image, _LINK.sub(link, text)))


def _outside_of_code(markdown: str, change: Callable[[str], str]) -> str:
    return "".join(part if number % 2 else change(part) for number, part in enumerate(_FENCED.split(markdown)))


def _targets(page: Path) -> list[Path]:
    found = []

    def note(text: str) -> str:
        found.extend(match["target"] for match in (*_LINK.finditer(text), *_IMAGE.finditer(text)))
        return text

    _outside_of_code(page.read_text(encoding="utf-8"), note)
    return [path for target in found if (path := _resolved(page, target)) is not None]


def _resolved(page: Path, target: str) -> Path | None:
    """Return the file to which a link points. Return None if the link points to a folder without a README.

    Raises PluginError if the target does not exist.
    """
    path = Path(os.path.normpath(page.parent / target))
    if path in SCHEMAS:
        return path
    if not path.exists():
        raise PluginError(f"{page.relative_to(ROOT)} links to {target}, which is not there")
    if path.is_dir():
        path /= "README.md"
        return path if path.exists() else None
    return path


def _uri(path: Path) -> str:
    if path == ROOT / "README.md":
        return HOME
    return path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT).as_posix()


def _source(uri: str) -> Path:
    return DOCS / uri if (DOCS / uri).exists() else ROOT / uri

"""Rank the search results of the documentation site: guides first, then explanations, then generated lists."""

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

BOOSTS = {
    "tutorial.md": 2.0,
    "how-to/": 4.0,
    "appendix/": 0.5,
    "benchmarks/": 0.25,
    "reference/api.md": 0.25,
    "reference/scenario-keys.md": 0.25,
    "CHANGELOG.md": 0.25,
}
"""Factors of search scores. A page whose path begins with a key has the factor of this key. Other pages have the factor
1.
"""


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    for start, boost in BOOSTS.items():
        if page.file.src_uri.startswith(start):
            page.meta.setdefault("search", {})["boost"] = boost
    return markdown

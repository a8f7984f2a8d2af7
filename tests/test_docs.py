"""Test the documentation: the site builds without warnings, loads nothing from other hosts, and all examples work."""

import importlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from docs.generate.json_schemas import texts
from harness.cli import COMMANDS, load_command
from harness.scenario.load import parse
from tests.harness.report.browser import open_browser
from tests.pages import play

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(directory)],
        cwd=REPOSITORY,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    return directory


def test_site_has_every_page_and_every_link_target(site: Path) -> None:
    for page in PAGES[1:]:
        name = "index.html" if page.stem == "README" else f"{page.stem}.html"
        assert (site / page.parent.relative_to(REPOSITORY / "docs") / name).exists(), page
    assert (site / "index.html").exists()
    assert (site / "ucp" / "contract" / "CONTRACT.html").exists()
    for page in site.rglob("*.html"):
        for target in re.findall(r'(?:href|src)="(?!https?:)([^"#:]+)', page.read_text()):
            if not target.startswith(("/", "data")) and page.name != "404.html":
                assert (page.parent / target).is_file(), (page, target)  # without a server, a folder is not a page


@pytest.mark.parametrize("page", sorted({*PAGES, *REPOSITORY.glob("*.md")}), ids=lambda page: page.stem)
def test_brackets_of_every_paragraph_are_closed(page: Path) -> None:
    without_code = re.sub(r"`[^`]*`", "", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL))
    for paragraph in re.split(r"\n\s*\n", without_code):
        assert paragraph.count("[") == paragraph.count("]"), paragraph
        assert paragraph.count("(") == paragraph.count(")"), paragraph


@pytest.mark.parametrize("page", sorted({*PAGES, *REPOSITORY.glob("*.md")}), ids=lambda page: page.stem)
def test_rows_of_every_table_have_as_many_cells_as_its_header(page: Path) -> None:
    for table in re.findall(r"(?:^ *\|.*\n)+", page.read_text(), re.MULTILINE):
        rows = [re.sub(r"`[^`]*`", "", row).replace("\\|", "") for row in table.splitlines()]
        assert [row for row in rows if row.count("|") != rows[0].count("|")] == []


def test_site_has_every_schema_and_a_page_that_links_to_it(site: Path) -> None:
    page = (site / "reference/schemas.html").read_text()
    for path, text in texts().items():
        assert (site / path).read_text() == text
        assert f'href="../{path}"' in page


def test_site_loads_nothing_from_other_hosts(site: Path) -> None:
    for page in site.rglob("*.html"):
        loads = re.findall(
            r'<(?:script|img|iframe|link rel="(?:stylesheet|icon|preconnect)")[^>]*?(?:src|href)="([^"]+)',
            page.read_text(),
        )
        assert loads
        assert not [source for source in loads if re.match(r"(?:https?:)?//", source)], page


QUERIES = {
    "install": "how-to/install.html",
    "uninstall": "how-to/install.html",
    "cite": "how-to/install.html",
    "seed": "how-to/install.html",
    "latency": "how-to/set-network-conditions.html",
    "docker": "how-to/run-in-containers.html",
}
"""A page that must be among the first `SHOWN` search results, by the search term."""
SHOWN = 3
SEARCH_DEADLINE_S = 20.0
TYPE = """(field => {
    field.focus();
    field.value = "%s";
    field.dispatchEvent(new KeyboardEvent("keyup", {key: "a", bubbles: true}));
})(document.querySelector(".md-search__input"))"""
FOUND = "[...document.querySelectorAll('.md-search-result__item > .md-search-result__link')].map(link => link.href)"


def test_page_of_the_site_searches_without_a_server(site: Path) -> None:
    assert (site / "search/search_index.js").read_text().startswith("var __index = {")
    for page in site.rglob("*.html"):
        assert "vendor/iframe-worker/shim.js" in page.read_text(), page


def test_search_of_the_site_opened_as_files_finds_the_page(site: Path, tmp_path: Path) -> None:
    with open_browser(tmp_path) as opened, opened.fresh() as browser:
        for query, page in QUERIES.items():
            browser.show(site / "tutorial.html", width=1200, scheme="light")
            browser.evaluate(TYPE % query)
            deadline = time.monotonic() + SEARCH_DEADLINE_S
            while not (found := browser.evaluate(FOUND)) and time.monotonic() < deadline:
                time.sleep(0.1)
            pages = [link.partition("?")[0].removeprefix(f"{site.resolve().as_uri()}/") for link in found]
            assert page in pages[:SHOWN], (query, pages)
        assert browser.complaints == []


def test_reference_page_has_keys_of_a_scenario(site: Path) -> None:
    text = (site / "reference/scenario-keys.html").read_text()
    for key in ("final_reconcile", "vote_timeout_s", "hold_until_s", "takeoff_altitude_m", "reboot"):
        assert f"<code>{key}</code>" in text
    assert "A program that follows ucp/contract/CONTRACT.md" in text  # a docstring in the source


def test_commands_page_has_each_command_and_option(site: Path) -> None:
    text = (site / "reference/commands.html").read_text()
    options = 0
    for name, command in all_commands():
        start = text.index(f">{name}<a")
        section = text[start : text.find("<h", start + 1)]
        for parameter in command.params:
            for option in (*parameter.opts, *parameter.secondary_opts) if parameter.param_type_name == "option" else ():
                assert re.search(rf"<code>(?:[^<]*[ /])?{re.escape(option)}\b", section), (name, option)
                options += 1
    assert options > 100


def test_commands_page_has_the_exit_statuses_of_each_command(site: Path) -> None:
    text = (site / "reference/commands.html").read_text()
    for name, command in all_commands():
        start = text.index(f">{name}<a")
        own = "xit status 0" in (command.help or "")
        assert ("<strong>Exit status</strong>" in text[start : text.find("<h", start + 1)]) == own, name


def all_commands() -> Iterator[tuple[str, Any]]:
    """Yield each command with its name. Commands in groups are included."""
    for name in COMMANDS:
        command = load_command(name)
        if hasattr(command, "commands"):
            yield from ((f"ucp-harness {name} {inner}", part) for inner, part in command.commands.items())
        else:
            yield f"ucp-harness {name}", command


def test_every_key_of_a_scenario_has_a_description() -> None:
    sys.path.insert(0, str(REPOSITORY / "docs" / "hooks"))
    reference = importlib.import_module("reference")
    rows = [line for line in reference.reference().splitlines() if line.startswith("| `")]
    assert len(rows) > 200
    assert [row for row in rows if row.endswith("|  |")] == []


def test_gallery_has_each_scenario_with_its_result_and_picture(site: Path) -> None:
    page = (site / "gallery.html").read_text()
    names = {path.stem for path in (REPOSITORY / "scenarios").glob("*.yaml") if not path.stem.endswith("_matrix")}
    assert set(re.findall(r"ucp-harness run (\w+) --backend sim --seed \d", page)) == names
    assert set(re.findall(r'<img alt="agents? [^"]+" src="gallery/(\w+)\.svg"', page)) == names
    assert {path.stem for path in (site / "gallery").iterdir()} == names
    assert page.count("Verdict: all checks are good.") > len(names) / 3
    assert "Verdict: characteristic 5 violated, characteristic 6 violated, swarm not finished." in page


def test_picture_of_the_rooms_shows_the_imports(site: Path) -> None:
    text = (site / "explanation/architecture.html").read_text()
    assert re.search(r"<title>\d+ of the files in report/ use archive/</title>", text)
    assert "use commands/</title>" not in text  # no room imports the commands


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.stem not in ("run-a-matrix-every-night", "try-a-protocol-change")],
    ids=lambda page: page.name,
)
def test_scenario_on_a_page_is_valid(page: Path) -> None:
    for block in re.findall(r"^```yaml\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
        document = yaml.safe_load(block)
        parse({"name": "shown", **document})


@pytest.mark.lab
def test_commands_of_the_tutorial_print_their_results(tmp_path: Path) -> None:
    assert play(REPOSITORY / "docs" / "tutorial.md", tmp_path) > 10


def test_commands_of_the_findings_print_their_results(tmp_path: Path) -> None:
    assert play(REPOSITORY / "docs" / "explanation" / "findings.md", tmp_path) > 7


def test_commands_of_the_page_on_protocol_changes_print_their_results(tmp_path: Path) -> None:
    assert play(REPOSITORY / "docs" / "how-to" / "try-a-protocol-change.md", tmp_path) == 6


def test_api_page_has_every_public_name(site: Path) -> None:
    page = (site / "reference/api.html").read_text()
    for module in ("harness.api", "ucp", "netem", "sitl"):
        for name in importlib.import_module(module).__all__:
            assert f'id="{module}.{name}"' in page, (module, name)


def test_python_of_the_notebook_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(
        r"^```python\n(.*?)^```", (REPOSITORY / "docs/how-to/use-a-notebook.md").read_text(), re.MULTILINE | re.DOTALL
    )
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block, names)  # noqa: S102  (our own page)
    assert names["runs"].height == 15
    assert names["by_loss"]["messages_per_block"].is_sorted()
    assert names["handled"].height > 1000
    assert set(names["late"].columns) == {"agent", "handler"}
    assert names["late"].height < names["handled"].height

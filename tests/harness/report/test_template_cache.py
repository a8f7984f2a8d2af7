"""Test the cache of compiled templates: it does not change pages, and a damaged file in it does no harm."""

from pathlib import Path

import pytest

from harness.report import html

PAGE = "<p>{{ words }}</p>{% for style in styles %}{{ style }}{% endfor %}"


@pytest.fixture
def template(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(html, "_HERE", tmp_path)
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    monkeypatch.setattr("sys.pycache_prefix", None)
    (tmp_path / "__pycache__").mkdir()
    path = tmp_path / "page.j2"
    path.write_text(PAGE)
    return path


def drawn(template: Path) -> str:
    """Render the page in the same way as a new process."""
    html._environment.cache_clear()
    return html.render(template, styles=["x"], words="a < b")


def cached(template: Path) -> list[Path]:
    return [*(template.parent / "__pycache__").iterdir()]


def test_template_is_compiled_once(template: Path) -> None:
    first = drawn(template)
    (file,) = cached(template)
    written = file.stat().st_mtime_ns
    assert drawn(template) == first == "<p>a &lt; b</p>x"
    assert cached(template) == [file] and file.stat().st_mtime_ns == written


def test_changed_template_is_compiled_again(template: Path) -> None:
    drawn(template)
    template.write_text("new {{ words }}")
    assert drawn(template) == "new a &lt; b"


@pytest.mark.parametrize("content", [b"", b"damaged", b"j2\x05\x00\x00\x00"])
def test_damaged_file_in_the_cache_is_replaced(template: Path, content: bytes) -> None:
    drawn(template)
    (file,) = cached(template)
    whole = file.read_bytes()
    file.write_bytes(content or whole[: len(whole) // 2])
    assert drawn(template) == "<p>a &lt; b</p>x"


def test_templates_are_cached_below_the_prefix_of_python(
    template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    below = Path(f"{tmp_path}/prefix{tmp_path}")
    below.mkdir(parents=True)
    monkeypatch.setattr("sys.pycache_prefix", f"{tmp_path}/prefix")
    drawn(template)
    assert len([*below.iterdir()]) == 1
    assert cached(template) == []


def test_nothing_is_written_without_a_cache_directory(template: Path) -> None:
    (template.parent / "__pycache__").rmdir()
    assert drawn(template) == "<p>a &lt; b</p>x"
    assert [path.name for path in template.parent.iterdir()] == ["page.j2"]

"""The scenarios that come along, by name: `loss_15` is scenarios/loss_15.yaml, wherever the harness is installed."""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_INSIDE = _PACKAGE / "scenarios"
FOLDER = _INSIDE if _INSIDE.is_dir() else _PACKAGE.parent / "scenarios"
"""In an installed package inside of it; in a checkout beside it. Who copied the package alone has none."""


def names() -> list[str]:
    """All of them, in alphabetical order."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def find(path: Path) -> Path:
    """The file that comes along by this name, if it is such a name and no file; else what was given."""
    named = f"{path}.yaml"
    if len(path.parts) != 1 or not FOLDER.is_dir() or named not in (scenario.name for scenario in FOLDER.iterdir()):
        return path
    return path if path.exists() else FOLDER / named


def opening(name: str) -> str:
    """The sentence that its file begins with."""
    comment = []
    for line in (FOLDER / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.removeprefix("#").strip())
    return " ".join(comment).partition(". ")[0].removesuffix(".") + "."

"""The inputs that are kept, a folder for each target: what once failed, as `regression-...`, and what covers most."""

from pathlib import Path

FOLDER = Path(__file__).parents[1] / "corpus"
REGRESSION = "regression-"
MOST_FILES = 300
MOST_BYTES = 500_000


def files_of(name: str) -> list[Path]:
    """Those of a target; none if it has none yet."""
    folder = FOLDER / name
    return sorted(path for path in folder.iterdir()) if folder.is_dir() else []

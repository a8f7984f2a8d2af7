"""The stored inputs, in a folder for each target: former failures as `regression-NAME`, and inputs that cover most."""

from pathlib import Path

FOLDER = Path(__file__).parents[1] / "corpus"
REGRESSION = "regression-"
MOST_FILES = 300
MOST_BYTES = 500_000


def files_of(name: str) -> list[Path]:
    """Return the stored inputs of a target. Empty if it has none yet."""
    folder = FOLDER / name
    return sorted(path for path in folder.iterdir()) if folder.is_dir() else []

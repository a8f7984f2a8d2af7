"""Find the stored inputs of each target.

These are inputs that once failed (`regression-NAME`), and the inputs that cover the most code.
"""

from pathlib import Path

FOLDER = Path(__file__).parents[1] / "corpus"
REGRESSION = "regression-"
MOST_FILES = 300
MOST_BYTES = 500_000


def files_of(name: str) -> list[Path]:
    """Return the stored inputs of a target. The list may be empty."""
    folder = FOLDER / name
    return sorted(path for path in folder.iterdir()) if folder.is_dir() else []

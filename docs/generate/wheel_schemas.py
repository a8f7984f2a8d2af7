"""Generate the JSON schemas when the Python package is built, and add them as files.

An editable install has no schema files. The code generates a schema when it needs one.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WheelSchemas(BuildHookInterface):  # type: ignore[type-arg]
    """Writes the JSON schemas to a temporary folder, which exists until the package is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        self._folder = TemporaryDirectory()
        if version == "editable":
            return
        folder = Path(self._folder.name)
        subprocess.run([sys.executable, "-m", "harness.json_schemas", str(folder)], cwd=self.root, check=True)
        for path in sorted(folder.rglob("*.schema.json")):  # the order of files in the wheel
            build_data["force_include"][str(path)] = path.relative_to(folder).as_posix()

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        self._folder.cleanup()

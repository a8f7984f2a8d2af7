"""Add generated files when the Python package is built. These are the JSON schemas, and compiled modules if UCP_COMPILE
is 1.

An editable install has no schema files. The code generates a schema when it needs one. Without UCP_COMPILE, the wheel
is pure Python, and a build needs no compiler. A wheel with compiled modules is for one version of Python and one
platform.
"""

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

COMPILES = os.environ.get("UCP_COMPILE", "0") not in ("", "0")
DIRECTORY = "harness/compiled_modules"
REQUIRED = ("mypy[mypyc]>=2.4", "setuptools>=65")


class WheelSchemas(BuildHookInterface):  # type: ignore[type-arg]
    """Writes the JSON schemas to a temporary folder, which exists until the package is built."""

    def dependencies(self) -> list[str]:
        """Return the packages that this build needs in addition to those in pyproject.toml."""
        return [*REQUIRED] if COMPILES else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        self._folder = TemporaryDirectory()
        if version == "editable":
            return
        folder = Path(self._folder.name)
        subprocess.run([sys.executable, "-m", "docs.generate.json_schemas", str(folder)], cwd=self.root, check=True)
        for path in sorted(folder.rglob("*.schema.json")):  # the order of files in the wheel
            build_data["force_include"][str(path)] = path.relative_to(folder).as_posix()
        if COMPILES:
            compiler = [sys.executable, "-m", "docs.generate.compiled_modules"]
            subprocess.run(compiler, cwd=self.root, check=True)
            build_data["force_include"][str(Path(self.root, DIRECTORY))] = DIRECTORY
            build_data |= {"pure_python": False, "infer_tag": True}

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        self._folder.cleanup()

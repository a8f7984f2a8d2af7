"""The test harness for UCP agents. `harness.cli` is its command line, and `harness.api` is its Python API."""

from harness.compiled import use_compiled_modules

use_compiled_modules()

"""The test harness for UCP agents. `harness.cli` is its command line, and `harness.api` is its Python API."""

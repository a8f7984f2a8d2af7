"""The test harness for UCP agents. `harness.cli` is the command line, and `harness.api` is the Python API."""

"""Backends: where the agents of a scenario run. The process backend is the real thing: processes and namespaces."""

"""Backends: where agents run. Real processes in namespaces, or virtual time; see `harness.mission`."""

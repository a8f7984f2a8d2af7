"""Backends: where the agents of a scenario run. Real processes in namespaces, or virtual time; see `harness.mission`."""

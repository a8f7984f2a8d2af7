"""The simulation backend, which runs the same agents as the process backend, in virtual time on a simulated network."""

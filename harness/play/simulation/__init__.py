"""The simulation backend. The agents of the process backend run in virtual time, on a simulated network."""

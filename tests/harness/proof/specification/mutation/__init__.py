"""Measure whether the comparison of agent and TLA+ specification detects mistakes in the specification.

The gate compares the agent core with the specification in TLA+. This comparison is worth as much as the mistakes that
it notices. `edits.yaml` therefore holds mistakes for each Algorithm. The program

    python -m tests.harness.proof.specification.mutation

plants each mistake into the specification, and finds the smallest comparison that distinguishes it from the core. It
writes the results to `score.json`, and the tables of docs/explanation/specification.md.
"""

"""Measure whether the comparison of the agent core with the TLA+ specification detects mistakes in the specification.

The tests compare the agent core with the specification in TLA+. The comparison is useful only if it detects mistakes.
Therefore `edits.yaml` contains mistakes for each Algorithm. The program

    python -m tests.harness.proof.specification.mutation

plants each mistake into the specification, and finds the cheapest comparison in which the specification differs from
the core. The program writes the results to `score.json`, and the tables of docs/explanation/specification.md.
"""

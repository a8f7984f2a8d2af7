"""Compute the share of planted mistakes that are detected: `python -m tests.harness.proof.specification.mutation
[JOBS]`.
"""

from tests.harness.proof.specification.mutation.score import main

raise SystemExit(main())

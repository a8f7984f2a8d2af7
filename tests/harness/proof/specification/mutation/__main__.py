"""`python -m tests.harness.proof.specification.mutation [JOBS]`: compute the mutation score of the specification."""

from tests.harness.proof.specification.mutation.score import main

raise SystemExit(main())

"""Many runs: matrices, exploration of seeds, and growth with the number of agents."""

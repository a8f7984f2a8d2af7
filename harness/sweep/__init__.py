"""Many runs: matrices with their fits of growth, and exploration of seeds."""

"""From a scenario to a verdict: one run in a directory, one in memory, and many on all cores."""

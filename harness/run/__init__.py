"""Play and judge a scenario: one run in a directory or in memory, or many runs on all processor cores."""

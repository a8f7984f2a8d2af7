"""Run and judge a scenario. A run takes place in a directory or in memory, and many runs use all processor cores."""

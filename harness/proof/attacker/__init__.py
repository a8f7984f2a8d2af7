"""The attacker in a proof: the messages that the holder of a captured vehicle's keys can send."""

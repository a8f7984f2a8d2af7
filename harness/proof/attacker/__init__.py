"""The attacker of a proof: the messages that the holder of a vehicle's keys can send."""

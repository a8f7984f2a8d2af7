"""The model of a proof: local and global states, and the steps that the real agents take in them."""

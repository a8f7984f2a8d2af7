"""The attacker in a proof. It has the keys of a captured vehicle, and can send the messages that these keys allow."""

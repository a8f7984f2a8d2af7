"""The agent contract: its text, JSON schemas, test vectors, specification, Wireshark dissector and example agents."""

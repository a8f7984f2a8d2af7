"""The agent contract: its text, schemas, test vectors, specification, dissector and example agents."""

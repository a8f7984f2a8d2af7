"""Secure missions: keys, signed blocks, sealed event data.

This package is a layer around the protocol. The protocol does not depend on it. An agent imports it only for a mission
with keys, because most of its modules need the extra `secure`.
"""

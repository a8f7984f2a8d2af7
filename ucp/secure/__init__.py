"""Secure missions: keys, signed blocks, sealed event data.

A layer around the protocol, which knows nothing of it. Only missions that have keys import anything of this package; it
needs the extra `secure`.
"""

"""Secure missions: keys, signed blocks, sealed event data.

This package is a layer around the protocol. The protocol does not depend on it. Only missions with keys import this
package, because it needs the extra `secure`.
"""

"""The keyring: the directory that holds the keys of a mission, and the files that vehicles receive from it.

`ucp.secure` describes how a vehicle uses its bundle.
"""

from harness.play.keyring.key_directory import Home, KeysError, load_depot_key

__all__ = ["Home", "KeysError", "load_depot_key"]

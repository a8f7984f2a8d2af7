"""Manage the keys of a mission: the directory that holds them, and the files that each vehicle receives.

`ucp.secure` describes how a vehicle uses its bundle.
"""

from harness.play.keyring.key_directory import KeyDirectory, KeysError, load_depot_key

__all__ = ["KeyDirectory", "KeysError", "load_depot_key"]

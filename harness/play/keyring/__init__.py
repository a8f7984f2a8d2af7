"""Manage the keys of a mission: the directory that holds the keys, and the files that each vehicle receives. See
`ucp.secure` for the use of these files on a vehicle.
"""

from harness.play.keyring.key_directory import KeyDirectory, KeysError, load_depot_key

__all__ = ["KeyDirectory", "KeysError", "load_depot_key"]

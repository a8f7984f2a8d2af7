"""Keys at home: the one directory where a mission's keys are made and kept, and what is handed out of it.

What a vehicle does with its bundle is `ucp.secure`.
"""

from harness.play.keyring.key_directory import Home, KeysError, load_depot_key

__all__ = ["Home", "KeysError", "load_depot_key"]

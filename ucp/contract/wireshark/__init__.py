"""A Wireshark dissector of UCP in Lua. `python -m ucp.contract.wireshark` prints its path."""

from pathlib import Path

DISSECTOR = Path(__file__).with_name("ucp.lua")

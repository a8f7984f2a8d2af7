"""A Wireshark dissector of UCP, in Lua. `python -m ucp.contract.wireshark` says where it is."""

from pathlib import Path

DISSECTOR = Path(__file__).with_name("ucp.lua")

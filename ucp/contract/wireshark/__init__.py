"""A Wireshark dissector for UCP, written in Lua. `python -m ucp.contract.wireshark` prints the path of its file."""

from pathlib import Path

DISSECTOR = Path(__file__).with_name("ucp.lua")

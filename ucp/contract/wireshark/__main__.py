"""Print the path of the Wireshark dissector: `wireshark -X lua_script:"$(python -m ucp.contract.wireshark)"
CAPTURE`.
"""

import sys

from ucp.contract.wireshark import DISSECTOR

sys.stdout.write(f"{DISSECTOR}\n")

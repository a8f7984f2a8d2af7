"""`wireshark -X lua_script:"$(python -m ucp.wireshark)" CAPTURE`"""

import sys

from ucp.wireshark import DISSECTOR

sys.stdout.write(f"{DISSECTOR}\n")

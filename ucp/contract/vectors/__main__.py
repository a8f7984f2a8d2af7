"""Write the test vectors of the agent contract (`python -m ucp.contract.vectors`). Existing files are replaced."""

from ucp.contract.vectors import write_all

write_all()

"""`python -m ucp.contract.vectors`: write the test vectors of the agent contract, and replace the present files."""

from ucp.contract.vectors import write_all

write_all()

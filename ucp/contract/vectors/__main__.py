"""`python -m ucp.contract.vectors`: write the test vectors of the agent contract again."""

from ucp.contract.vectors import write_all

write_all()

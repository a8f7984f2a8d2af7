"""`python -m ucp.vectors`: write the test vectors of the agent contract anew."""

from ucp.vectors import write_all

write_all()

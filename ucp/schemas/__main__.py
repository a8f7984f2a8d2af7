"""`python -m ucp.schemas`: write the JSON Schemas of the agent contract anew."""

from ucp.schemas import write_all

write_all()

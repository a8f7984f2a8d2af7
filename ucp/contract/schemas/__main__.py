"""`python -m ucp.contract.schemas`: write the JSON Schemas of the agent contract anew."""

from ucp.contract.schemas import write_all

write_all()

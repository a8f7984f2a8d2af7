"""`python -m harness.schemas`: write the JSON Schemas anew."""

from harness.schemas import write_all

write_all()

"""Generate the table of attacks on a secured mission. Each attack is played in virtual time.

`python -m docs.generate.threats` plays all rows, and writes the table into docs/explanation/security.md.
"""

from docs.generate.threats.rows import ROWS, Row
from docs.generate.threats.threat_table import outcome, table

__all__ = ["ROWS", "Row", "outcome", "table"]

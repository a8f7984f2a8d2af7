"""Who could harm a secured mission, and what comes of it: each row of the table is played, in virtual time.

`python -m docs.generate.threats` plays all, and puts the table into docs/explanation/security.md.
"""

from docs.generate.threats.rows import ROWS, Row
from docs.generate.threats.threat_table import outcome, table

__all__ = ["ROWS", "Row", "outcome", "table"]

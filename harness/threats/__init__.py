"""Who could harm a secured mission, and what comes of it: each row of the table is played, in virtual time.

`python -m harness.threats` plays all, and puts the table into docs/security.md.
"""

from harness.threats.rows import ROWS, Row
from harness.threats.table import outcome, table

__all__ = ["ROWS", "Row", "outcome", "table"]

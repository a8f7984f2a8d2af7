"""Write the scenarios of a matrix as files, with which `ucp-harness run` can play each run again."""

from pathlib import Path

import yaml

from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint
from ucp.agent_files import write_atomically

DIRECTORY = "cells"


def scenario_file(point: MatrixPoint) -> str:
    """Return the path of the scenario file, relative to the matrix's directory."""
    return f"{DIRECTORY}/{point.file_name}.yaml"


def write_scenarios(matrix: Matrix, directory: Path) -> None:
    """Write the scenarios for all combinations of values. Raises OSError if a file cannot be written."""
    (directory / DIRECTORY).mkdir(exist_ok=True)
    for path, point in {scenario_file(point): point for point in matrix.points}.items():
        scenario = matrix.scenario_at(point).model_dump(mode="json", exclude_defaults=True)
        text = yaml.safe_dump(scenario, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
        write_atomically(directory / path, text)

"""cells/*.yaml: the scenario of each loss and number of agents, with which `ucp-harness run` plays a run again."""

from pathlib import Path

import yaml

from harness.sweep.matrix._matrix_file import Matrix, Point
from ucp.agent_files import write_atomically

DIRECTORY = "cells"


def scenario_file(point: Point) -> str:
    """In the matrix's directory."""
    return f"{DIRECTORY}/{point.file_name}.yaml"


def write_scenarios(matrix: Matrix, directory: Path) -> None:
    """Raises OSError if the disk refuses."""
    (directory / DIRECTORY).mkdir(exist_ok=True)
    for path, point in {scenario_file(point): point for point in matrix.points}.items():
        scenario = matrix.scenario_at(point).model_dump(mode="json", exclude_defaults=True)
        text = yaml.safe_dump(scenario, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
        write_atomically(directory / path, text)

"""The public names of the harness. Other programs and notebooks should import names only from here.

    from harness.api import load_scenario, run

    finished = run(load_scenario("loss_15"), seed=7, backend="sim")
    print(finished.result.bad, finished.report)

Every other module of `harness` may change with any version. `ucp`, `netem` and `sitl` list their own public names.
A name is imported at its first use. Therefore `import harness.api` is fast, and a program that only reads archives does
not import the backends.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harness.archive.archive import HeldBlock, RecordedRun, RunArchive
    from harness.checker import Result, check
    from harness.checker.judgement import Finding, Judgement
    from harness.errors import HarnessError, MachineError, ScenarioError
    from harness.proof import Bounds, Limits, Proof, prove
    from harness.pytest_plugin.findings import Findings
    from harness.pytest_plugin.swarm_in_test import Swarm
    from harness.report.export.frames import blocks_frame, handler_runs_frame
    from harness.run.run import Run, run
    from harness.run.simulate import Simulated, simulate
    from harness.scenario import Scenario, load_scenario
    from harness.sweep.explore import Explored, explore
    from harness.sweep.matrix import Finished, Matrix, load_matrix, run_matrix
    from harness.sweep.matrix.matrix_frame import matrix_frame

__all__ = [
    "Bounds",
    "Explored",
    "Finding",
    "Findings",
    "Finished",
    "HarnessError",
    "HeldBlock",
    "Judgement",
    "Limits",
    "MachineError",
    "Matrix",
    "Proof",
    "RecordedRun",
    "Result",
    "Run",
    "RunArchive",
    "Scenario",
    "ScenarioError",
    "Simulated",
    "Swarm",
    "blocks_frame",
    "check",
    "explore",
    "handler_runs_frame",
    "load_matrix",
    "load_scenario",
    "matrix_frame",
    "prove",
    "run",
    "run_matrix",
    "simulate",
]

_NAMES_OF = {
    "harness.archive.archive": ("HeldBlock", "RecordedRun", "RunArchive"),
    "harness.checker": ("Result", "check"),
    "harness.checker.judgement": ("Finding", "Judgement"),
    "harness.errors": ("HarnessError", "MachineError", "ScenarioError"),
    "harness.proof": ("Bounds", "Limits", "Proof", "prove"),
    "harness.pytest_plugin.findings": ("Findings",),
    "harness.pytest_plugin.swarm_in_test": ("Swarm",),
    "harness.report.export.frames": ("blocks_frame", "handler_runs_frame"),
    "harness.run.run": ("Run", "run"),
    "harness.run.simulate": ("Simulated", "simulate"),
    "harness.scenario": ("Scenario", "load_scenario"),
    "harness.sweep.explore": ("Explored", "explore"),
    "harness.sweep.matrix": ("Finished", "Matrix", "load_matrix", "run_matrix"),
    "harness.sweep.matrix.matrix_frame": ("matrix_frame",),
}
"""Module -> its public names. The module is imported when one of these names is first used."""
_MODULE_OF = {name: module for module, names in _NAMES_OF.items() for name in names}

if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_MODULE_OF[name]), name)

    def __dir__() -> list[str]:
        return __all__

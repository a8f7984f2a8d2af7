"""A run in virtual time whose steps are watched while it is judged: following them once is enough for both."""

from typing import Any

from harness.checker import Evidence
from harness.checker.evidence import Watch
from harness.play.simulation.simulation import Simulation
from harness.run.simulate import InMemory, Simulated, simulate_in_memory
from harness.scenario import Scenario


def simulate_watched(scenario: Scenario, seed: int, watch: Watch, **options: Any) -> Simulated:
    """As `simulate` with traces; everything is delivered, so that branches in which nothing happens are seen, too."""
    return simulate_in_memory(_Watched(watch), scenario, seed, deliver_all=True, **options)


class _Watched(InMemory):
    def __init__(self, watch: Watch) -> None:
        super().__init__(tracing=True)
        self._watch = watch

    def evidence(self, simulation: Simulation) -> Evidence:
        evidence = super().evidence(simulation)
        evidence.watch = self._watch
        return evidence

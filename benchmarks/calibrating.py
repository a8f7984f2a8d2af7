"""Count how often the confidence intervals of `calibrate` contain the true parameters of simulated flights.

    python -m benchmarks.calibrating [--flights N] [--first NUMBER] [--channel PRESET]

Each flight is a run in virtual time with captures. The number of a flight determines its scenario. The scenario has the
vehicles' plans, and these parameters of the radio: the path loss exponent, the shadowing, the power, and a loss that
does not depend on the distance. `calibrate` gets the directory of the run. The true values of `range_m`, `spread` and
`floor` are those of `harness.field.calibrate._delivery_model`.

With `--channel`, all vehicles share a radio channel with this preset. The shadowing of each link is then correlated in
space and time, and frames collide.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random
from statistics import mean, median
from tempfile import TemporaryDirectory
from typing import Any

from harness.errors import HarnessError
from harness.field.calibrate._delivery_model import DeliveryModel
from harness.field.calibrate.calibration import CalibrationResult, calibrate, model_of
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.scenario import Scenario
from netem.channel import PRESETS
from netem.radio import LogDistance


def scenario_of(
    number: int, channel: str | None = None, agents: int = 5, duration_s: float = 1200.0
) -> tuple[dict[str, Any], DeliveryModel]:
    """Return the scenario of a flight and its true parameters. `channel` is the name of a preset of a shared
    channel.
    """
    rng = Random(f"calibrating/{number}")
    log_distance = {
        "exponent": round(rng.uniform(2.0, 3.0), 2),
        "shadowing_db": round(rng.uniform(2.0, 6.0), 2),
    }
    range_m = rng.uniform(250.0, 600.0)
    receiver = {}
    if channel is not None:
        preset = PRESETS[channel]
        receiver = {"sensitivity_dbm": preset.sensitivity_dbm, "frequency_hz": preset.frequency_hz}
    default = LogDistance(**log_distance, **receiver)
    log_distance["power_dbm"] = round(default.power_dbm - default.margin_db(range_m), 2)
    loss = rng.choice((0.0, 0.05, 0.15))
    radio = {"channel": {"preset": channel, **log_distance}} if channel else {"radio": {"log_distance": log_distance}}
    plans = []
    for vehicle in range(2, agents + 1):
        places = [[round(rng.uniform(-1, 1) * 1.2 * range_m) for _ in range(2)] for _ in range(8)]
        speed_ms = round(rng.uniform(3.0, 9.0), 1)
        legs = [{"take_off": 30}, *({"go_to": place, "speed_ms": speed_ms} for place in places)]
        plans.append({"vehicles": [vehicle], "plan": legs})
    scenario = {
        "name": f"calibrating {number}",
        "agents": agents,
        "duration_s": duration_s,
        "capture": True,
        "network": {"loss": loss, **radio},
        "flight": plans,
    }
    return scenario, model_of(LogDistance(**log_distance, **receiver), loss)


def calibrated(number: int, directory: Path, **options: Any) -> tuple[CalibrationResult, DeliveryModel]:
    """Simulate a flight and calibrate it. Return the calibration and the true parameters."""
    scenario, truth = scenario_of(number, **options)
    record = run(Scenario.model_validate(scenario), number, directory, SilentProgress(), "sim").directory
    return calibrate([record]), truth


def covered(calibration: CalibrationResult, truth: DeliveryModel) -> dict[str, bool]:
    """Return, for each true parameter, whether its confidence interval contains it. The result is empty if `calibrate`
    found no fit.
    """
    if calibration.fit is None:
        return {}
    intervals = calibration.fit.intervals
    return {name: getattr(truth, name) in intervals[name] for name in ("range_m", "spread", "floor")}


def _results(numbers: range, channel: str | None) -> Iterator[tuple[int, CalibrationResult, DeliveryModel]]:
    for number in numbers:
        with TemporaryDirectory() as directory:
            try:
                yield number, *calibrated(number, Path(directory) / "run", channel=channel)
            except HarnessError as error:
                sys.stdout.write(f"{number}: {error}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--flights", type=int, default=30)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--channel", metavar="PRESET", choices=PRESETS)
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    widths: list[float] = []
    scores: list[float] = []
    for number, calibration, truth in _results(range(options.first, options.first + options.flights), options.channel):
        result = covered(calibration, truth)
        if calibration.fit is None or not result:
            counts["without a fit"] += 1
            continue
        counts["fitted"] += 1
        counts.update(name for name, inside in result.items() if inside)
        interval = calibration.fit.intervals["range_m"]
        widths.append((interval.high - interval.low) / truth.range_m)
        if calibration.validation:
            scores.append(calibration.validation.constant_log_score - calibration.validation.log_score)
        missed = ", ".join(
            f"{name} {getattr(truth, name):.3f} not in {calibration.fit.intervals[name].low:.3f} to "
            f"{calibration.fit.intervals[name].high:.3f}"
            for name, inside in result.items()
            if not inside
        )
        sys.stdout.write(f"{number}: {len(calibration.attempts)} messages; {missed or 'all covered'}\n")
        sys.stdout.flush()
    fitted = counts["fitted"]
    for name in ("range_m", "spread", "floor"):
        sys.stdout.write(f"{name}: covered in {counts[name]} of {fitted} flights\n")
    sys.stdout.write(f"without a fit: {counts['without a fit']}\n")
    if widths and scores:
        sys.stdout.write(f"width of the interval of range_m: {median(widths):.1%} of the range (median)\n")
        sys.stdout.write(
            f"log score of the last third: better than with one loss in {sum(score > 0 for score in scores)} of "
            f"{len(scores)} flights, by {mean(scores):.3f} on average\n"
        )


if __name__ == "__main__":
    main()

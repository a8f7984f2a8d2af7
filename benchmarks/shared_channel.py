"""Measure the cost of a shared radio channel in virtual time: `python -m benchmarks.shared_channel [--rounds 5]`.

Each round plays the same mission without and with a channel, one after the other, with the same seed. The ratio
compares the processor times of these two runs. A channel changes the number of messages, so the table also shows this
number. The runs write no traces.
"""

import argparse
import statistics
from functools import partial

from benchmarks.simulation import ms, print_row, seconds
from harness.run.simulate import simulate
from harness.scenario import Scenario


def scenario(agents: int, duration_s: float, preset: str | None) -> Scenario:
    network = {"channel": {"preset": preset}} if preset else {}
    document = {"name": "benchmark", "agents": agents, "duration_s": duration_s, "network": network}
    return Scenario.model_validate({**document, "settle": {"limit_s": 300}})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="number of rounds")
    parser.add_argument("--agents", type=int, nargs="+", default=[5, 20, 50], help="numbers of agents")
    parser.add_argument("--duration", type=float, default=1200.0, help="mission seconds")
    parser.add_argument("--presets", nargs="+", default=["wifi_1", "wifi_6"], help="presets of the channel")
    arguments = parser.parse_args()
    print_row("agents", "preset", "messages", "with channel", "time", "with channel", "ratio")
    for agents in arguments.agents:
        for preset in arguments.presets:
            row(agents, arguments.duration, preset, arguments.rounds)


def row(agents: int, duration_s: float, preset: str, rounds: int) -> None:
    ideal, shared = scenario(agents, duration_s, None), scenario(agents, duration_s, preset)
    messages: dict[int, list[int]] = {0: [], 1: []}
    times: dict[int, list[float]] = {0: [], 1: []}
    for seed in range(rounds):
        for number, what in enumerate((ideal, shared)):
            sent: list[int] = []
            times[number].append(seconds(partial(play, what, seed, sent)))
            messages[number] += sent
    ratios = [after / before for before, after in zip(times[0], times[1], strict=True)]
    print_row(
        str(agents),
        preset,
        *(str(round(statistics.median(messages[number]))) for number in (0, 1)),
        *(ms(statistics.median(times[number])) for number in (0, 1)),
        f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})",
    )


def play(what: Scenario, seed: int, sent: list[int]) -> None:
    sent.append(int(simulate(what, seed).result.figures["messages"] or 0))


if __name__ == "__main__":
    main()

"""Calibrate the radio model of a flight: fit the model, test it on the end of the flight, and write a
scenario with it.
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.errors import FieldError
from harness.field.calibrate._attempts import observe, pairs_of
from harness.field.calibrate._delivery_model import (
    ConfidenceInterval,
    DeliveryModel,
    FittedModel,
    TransmissionAttempt,
    fit,
    wilson,
)
from harness.field.calibrate._positions import Positions, SignalFit, find_positions, fit_signal
from harness.field.ingest import ingest_files
from harness.scenario import Scenario
from netem.channel import PRESETS
from netem.radio import LogDistance

TRAINING_SHARE = 2 / 3
"""Share of the flight, from its start on, to which the model is fitted for the validation. The fitted model then
predicts the rest of the flight.
"""
BLOCK_S = 120.0
_BINS = 10
_MAX_LOSS = 0.9999


@dataclass(frozen=True)
class ModelValidation:
    """The test of a model that was fitted to the beginning of the flight. The model predicts the rest of the flight,
    and is compared with a constant loss rate.

    A lower score is better. `bins` has an entry for each tenth of the predicted probability: the number of messages,
    the mean prediction, and the share that arrived.
    """

    attempts: int
    brier: float
    constant_brier: float
    log_score: float
    constant_log_score: float
    bins: list[tuple[int, float, float]]

    @property
    def sentence(self) -> str:
        word = "better" if self.log_score < self.constant_log_score else "worse"
        return (
            f"the last third of the flight is predicted {word} than by one loss for all messages: log score "
            f"{self.log_score:.3f} against {self.constant_log_score:.3f}, Brier score {self.brier:.3f} against "
            f"{self.constant_brier:.3f}"
        )


@dataclass(frozen=True)
class DeliveryShare:
    """The share of messages that arrived. Its confidence interval assumes independent messages."""

    attempts: int
    delivered: int
    mean_distance_m: float
    interval: ConfidenceInterval

    @property
    def delivery(self) -> float:
        return self.delivered / self.attempts


@dataclass(frozen=True)
class LinkDelivery:
    """The share of messages that arrived over one link. `total` is the share in the whole flight. `over_time` maps the
    start of each block of `BLOCK_S` mission seconds to the share in this block.
    """

    one: int
    other: int
    total: DeliveryShare
    over_time: dict[float, DeliveryShare]


@dataclass(frozen=True)
class CalibrationResult:
    """The result of the calibration for one flight."""

    roster: list[int]
    attempts: list[TransmissionAttempt]
    source: str
    positions: Positions
    fit: FittedModel | None
    validation: ModelValidation | None
    signal: SignalFit | None
    links: list[LinkDelivery]
    problems: list[str]
    duration_s: float

    @property
    def exponent(self) -> float:
        return self.signal.exponent if self.signal else LogDistance.exponent

    def sentences(self) -> Iterator[str]:
        """Yield sentences that describe the result of the calibration."""
        delivered = sum(attempt.delivered for attempt in self.attempts)
        yield (
            f"{delivered} of {len(self.attempts)} messages over {len(self.links)} links arrived, from {self.source} "
            f"and the positions of {len(self.positions.tracks)} vehicles"
        )
        if self.fit is None:
            if self.attempts:
                farthest_m = max(attempt.distance_m for attempt in self.attempts)
                yield (
                    f"the range cannot be estimated from these messages, at distances up to {farthest_m:.0f} m, so the "
                    "scenario has one loss for all messages"
                )
            return
        model, intervals = self.fit.model, self.fit.intervals
        yield f"half of the messages arrive at {model.range_m:.0f} m ({_interval(intervals['range_m'], '.0f')} m)"
        yield f"the spread is {model.spread:.3f} ({_interval(intervals['spread'], '.3f')}), in ln(distance)"
        if self.signal:
            yield (
                f"the exponent is {self.signal.exponent:.2f} ({_interval(self.signal.interval, '.2f')}), from "
                f"{self.signal.samples} signal strengths"
            )
        else:
            yield f"the exponent is assumed to be {self.exponent:g}, because delivery alone does not determine it"
        yield f"the shadowing is {self.exponent * model.spread * 10 / math.log(10):.2f} dB at this exponent"
        yield f"{model.floor:.1%} of the messages are lost at any distance ({_interval(intervals['floor'], '.1%')})"
        if "load" in intervals:
            range_of_load = _interval(intervals["load"], ".1%")
            yield f"each message of another vehicle within 5 ms costs {model.load:.1%} more ({range_of_load})"
        if self.validation:
            yield self.validation.sentence

    def network(self, preset: str | None = None) -> dict[str, object]:
        """Return the section `network` of a scenario. Without a `preset`, the section contains a radio and a loss rate.
        The loss rate includes the losses by messages of other vehicles. With a `preset`, the section contains a shared
        channel and the loss rate `floor`, because the channel itself simulates the losses by other messages. If no
        model was fitted, the section contains only the mean loss rate.
        """
        if self.fit is None:
            delivered = sum(attempt.delivered for attempt in self.attempts)
            return {"loss": round(1 - delivered / len(self.attempts), 4)} if self.attempts else {}
        model = self.fit.model
        mean_load = sum(attempt.others for attempt in self.attempts) / len(self.attempts)
        loss = 1 - (1 - model.floor) * math.exp(-model.load * mean_load)
        shadowing_db = self.exponent * model.spread * 10 / math.log(10)
        if preset is not None:
            channel = PRESETS[preset]
            default = LogDistance(self.exponent, shadowing_db, 0.0, channel.sensitivity_dbm, channel.frequency_hz)
            fitted = {
                "exponent": round(self.exponent, 4),
                "shadowing_db": round(shadowing_db, 4),
                "power_dbm": round(-default.margin_db(model.range_m), 4),
            }
            return {"loss": round(min(model.floor, _MAX_LOSS), 4), "channel": {"preset": preset, **fitted}}
        default = LogDistance(exponent=self.exponent, shadowing_db=shadowing_db)
        power_dbm = default.power_dbm - default.margin_db(model.range_m)
        return {
            "loss": round(min(max(loss, 0.0), _MAX_LOSS), 4),
            "radio": {
                "log_distance": {
                    "exponent": round(self.exponent, 4),
                    "shadowing_db": round(shadowing_db, 4),
                    "power_dbm": round(power_dbm, 4),
                }
            },
        }

    def scenario(self, name: str, preset: str | None = None) -> dict[str, object]:
        """Return a scenario with the fitted network. The scenario has no flight plans, because only the network is
        fitted.
        """
        document = {
            "name": name,
            "agents": self.roster,
            "duration_s": max(60, round(self.duration_s)),
            "network": self.network(preset),
        }
        Scenario.model_validate(document)
        return document

    def to_json(self) -> dict[str, object]:
        """Return the result of the calibration as a JSON object."""
        return {
            "messages": len(self.attempts),
            "delivered": sum(attempt.delivered for attempt in self.attempts),
            "source": self.source,
            "positions": {str(vehicle): source for vehicle, source in sorted(self.positions.sources.items())},
            "fit": self.fit
            and {
                name: {"value": getattr(self.fit.model, name), "interval": [*interval]}
                for name, interval in self.fit.intervals.items()
            },
            "exponent": {
                "value": self.exponent,
                "interval": [*self.signal.interval] if self.signal else None,
                "assumed": self.signal is None,
            },
            "validation": self.validation and self.validation.__dict__,
            "links": [
                {
                    "vehicles": [link.one, link.other],
                    **_share_json(link.total),
                    "over_time": [{"at_s": at_s, **_share_json(share)} for at_s, share in link.over_time.items()],
                }
                for link in self.links
            ],
            "problems": self.problems,
        }


def _share_json(share: DeliveryShare) -> dict[str, object]:
    return {
        "messages": share.attempts,
        "delivered": share.delivered,
        "mean_distance_m": round(share.mean_distance_m, 1),
        "interval": [*share.interval],
    }


def _interval(interval: ConfidenceInterval, form: str) -> str:
    return f"95 %: {interval.low:{form}} to {interval.high:{form}}"


def calibrate(paths: Sequence[Path]) -> CalibrationResult:
    """Fit the radio model to the largest flight in these files and directories.

    Raises FieldError if the files have no message whose receivers are known.
    """
    result = ingest_files(paths)
    flight = result.largest()
    vehicles = flight.roster or tuple(flight.agents)
    epoch_us = flight.epoch_us or 0
    positions = find_positions(paths, flight, vehicles, epoch_us)
    observed = observe(flight, positions, epoch_us)
    problems = [
        sentence for sentence in result.sentences() if not re.search(r"\.(bin|tlog)\b", sentence, re.IGNORECASE)
    ]
    problems += [*positions.problems, *observed.problems]
    without = sorted(set(vehicles) - positions.tracks.keys())
    if without:
        names = ", ".join(map(str, without))
        problems.append(f"vehicles without positions: {names}; messages from and to them are not used")
    if len(flight.agents) < 2:
        problems.append("there are records of one vehicle only, so the receivers of its messages are unknown")
    attempts = observed.attempts
    if not attempts:
        error = FieldError(
            "no message has a known receiver and known distance: add traces or captures of at least two vehicles, and "
            "their flight logs"
        )
        error.details = problems
        raise error
    end_s = max(attempt.at_s for attempt in attempts)
    return CalibrationResult(
        roster=sorted(vehicles),
        attempts=attempts,
        source=observed.source,
        positions=positions,
        fit=fit(attempts),
        validation=validate(attempts),
        signal=fit_signal(positions),
        links=_links(attempts),
        problems=problems,
        duration_s=end_s,
    )


def validate(attempts: Sequence[TransmissionAttempt]) -> ModelValidation | None:
    """Fit the model to the beginning of the flight, and test how well it predicts the end. Return None if the beginning
    is not sufficient for a fit.
    """
    first_s, last_s = min(each.at_s for each in attempts), max(each.at_s for each in attempts)
    until_s = first_s + TRAINING_SHARE * (last_s - first_s)
    training = [attempt for attempt in attempts if attempt.at_s <= until_s]
    unseen = [attempt for attempt in attempts if attempt.at_s > until_s]
    fitted = fit(training) if unseen else None
    if fitted is None:
        return None
    constant = sum(attempt.delivered for attempt in training) / len(training)
    predicted = [fitted.model.delivery(attempt.distance_m, attempt.others) for attempt in unseen]
    bins: list[list[tuple[float, bool]]] = [[] for _ in range(_BINS)]
    for probability, attempt in zip(predicted, unseen, strict=True):
        bins[min(int(probability * _BINS), _BINS - 1)].append((probability, attempt.delivered))
    outcomes = [attempt.delivered for attempt in unseen]
    return ModelValidation(
        attempts=len(unseen),
        brier=_brier(predicted, outcomes),
        constant_brier=_brier([constant] * len(unseen), outcomes),
        log_score=_log_score(predicted, outcomes),
        constant_log_score=_log_score([constant] * len(unseen), outcomes),
        bins=[
            (len(each), sum(p for p, _ in each) / len(each), sum(d for _, d in each) / len(each))
            for each in bins
            if each
        ],
    )


def _brier(predicted: Sequence[float], outcomes: Sequence[bool]) -> float:
    return sum((p - d) ** 2 for p, d in zip(predicted, outcomes, strict=True)) / len(outcomes)


def _log_score(predicted: Sequence[float], outcomes: Sequence[bool]) -> float:
    """Return the mean of -ln(p) over all transmissions, where p is the predicted probability of the observed outcome.
    Probabilities are limited to 0.001 to 0.999.
    """
    bounded = [min(max(p, 0.001), 0.999) for p in predicted]
    return -sum(math.log(p if d else 1 - p) for p, d in zip(bounded, outcomes, strict=True)) / len(outcomes)


def _links(attempts: Sequence[TransmissionAttempt]) -> list[LinkDelivery]:
    of_link: dict[frozenset[int], list[TransmissionAttempt]] = defaultdict(list)
    for attempt in attempts:
        of_link[attempt.link].append(attempt)
    links = []
    for pair in pairs_of(attempts):
        one, other = sorted(pair)
        blocks: dict[float, list[TransmissionAttempt]] = defaultdict(list)
        for attempt in of_link[pair]:
            blocks[attempt.at_s // BLOCK_S * BLOCK_S].append(attempt)
        over_time = {at_s: share_of(inside) for at_s, inside in sorted(blocks.items())}
        links.append(LinkDelivery(one, other, share_of(of_link[pair]), over_time))
    return links


def share_of(attempts: Sequence[TransmissionAttempt]) -> DeliveryShare:
    """Return the share of these messages that arrived. There must be at least one message."""
    delivered = sum(attempt.delivered for attempt in attempts)
    mean_m = sum(attempt.distance_m for attempt in attempts) / len(attempts)
    return DeliveryShare(len(attempts), delivered, mean_m, wilson(delivered, len(attempts)))


def model_of(radio: LogDistance, loss: float = 0.0) -> DeliveryModel:
    """Return the delivery model that is equivalent to this radio together with an additional loss rate: at each
    distance, a message arrives with the same probability.
    """
    range_m = 10 ** (radio.margin_db(1.0) / (10 * radio.exponent))
    return DeliveryModel(range_m, radio.shadowing_db * math.log(10) / (10 * radio.exponent), loss)

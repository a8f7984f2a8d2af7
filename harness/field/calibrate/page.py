"""Write the page of a calibration. It shows arrivals over distance, residuals, the test of the model, arrivals over
time, and a map.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from harness.field.calibrate._delivery_model import TransmissionAttempt
from harness.field.calibrate.calibration import CalibrationResult, share_of
from harness.present import svg
from harness.present.colours import inks
from harness.present.svg import FONT, Axis, n
from harness.report import html, map_svg
from harness.report.map_parts import MapProjection, extent, thin

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_BINS_PER_FOLD = 4
_PANEL_HEIGHT = 300
_MAX_MAP_POINTS = 20_000


def draw(calibration: CalibrationResult, name: str) -> str:
    """Return the page about a calibration as HTML."""
    return html.render(
        _TEMPLATE,
        styles=[map_svg.STYLE + html.PAGE_STYLE],
        title=name,
        sentences=[*calibration.sentences()],
        problems=calibration.problems,
        distance=_picture("Delivery over distance", "distance-", [_delivery(calibration), _residuals(calibration)]),
        prediction=_picture("Prediction of the last third", "prediction-", [_predictions(calibration)])
        if calibration.validation
        else None,
        time=_picture("Delivery over time", "time-", [_over_time(calibration)]),
        map=_map(calibration),
        links=calibration.links,
        fit=calibration.fit,
    )


def _picture(heading: str, ids: str, panels: Sequence[Markup]) -> Markup:
    about = "" if ids == "prediction-" else "Vertical lines: 95 % intervals of independent messages."
    document = svg.document(60 + _PANEL_HEIGHT + 30, heading, about, heading, panels, "", ids=ids)
    return Markup(document)  # noqa: S704 - the parts escape all texts


def _bins(attempts: Sequence[TransmissionAttempt]) -> list[list[TransmissionAttempt]]:
    bins: dict[int, list[TransmissionAttempt]] = defaultdict(list)
    for attempt in attempts:
        bins[math.floor(_BINS_PER_FOLD * math.log(max(attempt.distance_m, 1.0)))].append(attempt)
    return [bins[key] for key in sorted(bins)]


def _areas(count: int) -> list[svg.ChartArea]:
    return svg.grid(count, count, 60, _PANEL_HEIGHT)


def _distance_axis(calibration: CalibrationResult, area: svg.ChartArea) -> Axis:
    distances = [max(attempt.distance_m, 1.0) for attempt in calibration.attempts]
    return svg.log_axis(min(distances), max(max(distances), min(distances) * 1.1), area.across)


def _bar(x: float, low: float, high: float) -> Markup:
    return Markup('<path class="rule" d="M{} {}V{}" stroke="{}" stroke-width="1.5"/>').format(
        n(x), n(low), n(high), svg.COLOURS[0]
    )


def _percents(axis: Axis) -> list[str]:
    return [f"{tick:.0%}" for tick in axis.ticks]


def _delivery(calibration: CalibrationResult) -> Markup:
    area = _areas(2)[0]
    across, up = _distance_axis(calibration, area), svg.share_axis(area.up)
    parts = [
        svg.frame("delivered share, over metres", across, up, [f"{tick:g}" for tick in across.ticks], _percents(up))
    ]
    if calibration.fit:
        steps = [across.first * (across.last / across.first) ** (step / 80) for step in range(81)]
        model = calibration.fit.model
        parts.append(svg.line([(across(metres), up(model.delivery(metres))) for metres in steps], 1))
    for inside in _bins(calibration.attempts):
        share = share_of(inside)
        x = across(max(share.mean_distance_m, 1.0))
        parts.append(_bar(x, up(share.interval.low), up(share.interval.high)))
        tip = f"{share.mean_distance_m:.0f} m: {share.delivered} of {share.attempts} messages arrived"
        parts.append(svg.dot(x, up(share.delivery), 0, tip))
    return Markup("").join(parts)


def _residuals(calibration: CalibrationResult) -> Markup:
    """Draw the residuals: the share of messages that arrived minus the share that the model predicts. If no model was
    fitted, the predicted share is constant.
    """
    area = _areas(2)[1]
    across, up = _distance_axis(calibration, area), svg.linear_axis(-0.5, 0.5, area.up)
    texts = [f"{tick:+.0%}" for tick in up.ticks]
    parts = [svg.frame("residual, over metres", across, up, [f"{tick:g}" for tick in across.ticks], texts)]
    parts.append(svg.line([(across.start, up(0.0)), (across.end, up(0.0))], 1))
    constant = share_of(calibration.attempts).delivery
    for inside in _bins(calibration.attempts):
        share = share_of(inside)
        model = calibration.fit.model if calibration.fit else None
        expected = (
            sum(model.delivery(each.distance_m, each.others) for each in inside) / len(inside) if model else constant
        )
        x = across(max(share.mean_distance_m, 1.0))
        parts.append(_bar(x, up(share.interval.low - expected), up(share.interval.high - expected)))
        tip = f"{share.mean_distance_m:.0f} m: {share.delivery - expected:+.1%} of {share.attempts} messages"
        parts.append(svg.dot(x, up(share.delivery - expected), 0, tip))
    return Markup("").join(parts)


def _predictions(calibration: CalibrationResult) -> Markup:
    area = _areas(1)[0]
    across, up = svg.share_axis(area.across), svg.share_axis(area.up)
    parts = [svg.frame("delivered share, over predicted probability", across, up, _percents(across), _percents(up))]
    parts.append(svg.line([(across(0.0), up(0.0)), (across(1.0), up(1.0))], 1))
    validation = calibration.validation
    for count, predicted, delivered in validation.bins if validation else ():
        tip = f"predicted {predicted:.1%}, delivered {delivered:.1%} of {count} messages"
        parts.append(svg.dot(across(predicted), up(delivered), 0, tip))
    return Markup("").join(parts)


def _over_time(calibration: CalibrationResult) -> Markup:
    area = _areas(1)[0]
    blocks: dict[float, list[TransmissionAttempt]] = defaultdict(list)
    for attempt in calibration.attempts:
        blocks[attempt.at_s // 60 * 60].append(attempt)
    across = svg.linear_axis(min(blocks), max(blocks) + 60, area.across)
    up = svg.share_axis(area.up)
    parts = [
        svg.frame("delivered share, over seconds", across, up, [f"{tick:g}" for tick in across.ticks], _percents(up))
    ]
    model = calibration.fit.model if calibration.fit else None
    if model:
        points = [
            (across(at_s + 30), up(sum(model.delivery(each.distance_m, each.others) for each in inside) / len(inside)))
            for at_s, inside in sorted(blocks.items())
        ]
        parts.append(svg.line(points, 1))
    for at_s, inside in sorted(blocks.items()):
        share = share_of(inside)
        parts.append(_bar(across(at_s + 30), up(share.interval.low), up(share.interval.high)))
        tip = f"{at_s:.0f} s: {share.delivered} of {share.attempts} messages, at {share.mean_distance_m:.0f} m"
        parts.append(svg.dot(across(at_s + 30), up(share.delivery), 0, tip))
    return Markup("").join(parts)


def _map(calibration: CalibrationResult) -> Markup:
    """Draw the paths of the vehicles, and a dot for each lost message."""
    tracks = calibration.positions.tracks
    ink = inks(calibration.roster)
    projection = MapProjection(extent([fix for track in tracks.values() for fix in track]), 62, 14, 800, 460)
    lines = thin([[projection(fix) for fix in track] for track in tracks.values()], _MAX_MAP_POINTS)
    paths = []
    for vehicle, line in zip(tracks, lines, strict=True):
        path = "M" + "L".join(f"{n(x)} {n(y)}" for x, y in line)
        paths.append(
            Markup(
                '<g class="track"><title>vehicle {}</title><path class="edge" d="{p}" stroke="{}"/>'
                '<path d="{p}" stroke="{}"/></g>'
            ).format(vehicle, ink[vehicle].stroke, ink[vehicle].fill, p=path)
        )
    lost = [attempt for attempt in calibration.attempts if not attempt.delivered]
    marks = []
    for attempt in lost[:: max(1, len(lost) // 400)]:
        place = calibration.positions.at(attempt.receiver, attempt.at_s)
        if place is not None:
            x, y = projection(place)
            away = f"{attempt.distance_m:.0f} m away"
            tip = f"{attempt.at_s:.0f} s: vehicle {attempt.receiver} lost a message of {attempt.sender}, {away}"
            marks.append(
                Markup('<circle class="logged" cx="{}" cy="{}" r="2.5" fill="{}"><title>{}</title></circle>').format(
                    n(x), n(y), ink[attempt.sender].fill, tip
                )
            )
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="map" role="img" width="{w}" height="{h}" viewBox="0 0 {w} {h}"'
        ' aria-labelledby="map-title" font-family="{font}" font-size="12"><title id="map-title">Map</title>'
        "{frame}{paths}{marks}{tags}</svg>"
    ).format(
        w=n(76 + projection.width),
        h=n(76 + projection.height),
        font=FONT,
        frame=map_svg.frame(projection),
        paths=Markup("").join(paths),
        marks=Markup("").join(marks),
        tags=map_svg.tags([(vehicle, projection(track[-1])) for vehicle, track in tracks.items()], [], projection, ink),
    )

"""Test the keys of `network.channel`: a preset, other values for single keys of the preset, and errors of one
sentence.
"""

import typing
from dataclasses import fields

import pytest

from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.scenario._channel import OWN_KEYS, ChannelModel, Preset
from harness.scenario.load import parse, parse_yaml
from netem.channel import PRESETS

SCENARIO = "name: Channel\nagents: 3\nnetwork: {channel: {preset: wifi_1%s}%s}\n%s"


def scenario(figures: str = "", network: str = "", more: str = "") -> Scenario:
    return parse(parse_yaml(SCENARIO % (figures, network, more)))


def test_scenario_may_name_every_preset_and_every_figure() -> None:
    assert set(typing.get_args(Preset)) == PRESETS.keys()
    figures = {field.name for radio in PRESETS.values() for field in fields(radio)}
    assert ChannelModel.model_fields.keys() - {*OWN_KEYS} == figures


def test_key_replaces_a_figure_of_the_preset() -> None:
    channel = scenario(", rate_bps: 2.0e+6, queue_frames: 3").network.channel
    assert channel is not None
    radio = channel.radio()
    assert radio.queue_frames == 3
    assert radio.airtime_ns(47) == 192_000 + 444_000
    assert radio.power_dbm == PRESETS["wifi_1"].power_dbm


@pytest.mark.parametrize(
    ("figures", "problem"),
    [
        (", rate_bps: 0", "channel.rate_bps: 0.0 is out of range; allowed is 8 to 1e+10"),
        (", rate_bps: -1000000", "channel.rate_bps: -1000000.0 is out of range"),
        (", rate_bps: .nan", "channel.rate_bps: nan is out of range"),
        (", antenna_m: -0.5", "channel.antenna_m: -0.5 is out of range; allowed is 0 to 10000"),
        (", queue_frames: 0", "channel.queue_frames: 0 is out of range; allowed is 1 to 100000"),
        (", eifs_s: 0.00001", "channel.eifs_s: 1e-05 is below difs_s, 5e-05; allowed is difs_s or more"),
        (", spreading_factor: 7", "`spreading_factor` is not a key of the radio preset wifi_1: leave it out"),
        (", duty: 0.01", "`duty` is not a key of the radio preset wifi_1: leave it out"),
        (", processing_s: -1", "network.channel.processing_s"),
    ],
)
def test_wrong_figure_is_refused_in_one_sentence(figures: str, problem: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        scenario(figures)
    assert problem in str(refused.value)
    assert "\n" not in str(refused.value).strip()


@pytest.mark.parametrize(
    ("network", "more", "problem"),
    [
        (", radio: {log_distance: {}}", "", "`radio` and `channel` both compute the loss over distance"),
        (", rate: 1000", "", "`rate` and `network.channel` both queue messages: leave out one"),
        (", delay: 0.1, limit: 5", "", "`limit` and `network.channel` both queue messages: leave out one"),
        (
            "",
            "timeline: [{at_s: 5, network: {receivers: {2: {rate: 100}}}}]",
            "`receivers 2 rate` and `network.channel`",
        ),
        ("", "vehicles: {kind: none}", "`network.channel` needs vehicles, but `vehicles.kind` is none"),
    ],
)
def test_channel_refuses_conditions_that_it_computes_itself(network: str, more: str, problem: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        scenario(network=network, more=more)
    assert problem in str(refused.value)


def test_unknown_preset_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ScenarioError, match="preset"):
        parse(parse_yaml("name: Channel\nnetwork: {channel: {preset: wifi_2}}\n"))

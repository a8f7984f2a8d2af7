"""Simulate a radio channel that all vehicles share. The module `_channel.py` describes the model."""

from netem.channel._channel import Channel
from netem.channel._frame import EndedTransmission, FrameFate, numbers
from netem.channel._parameters import LoraRadio, Radio, TimeSlotRadio, WifiRadio
from netem.channel._presets import PRESETS

__all__ = [
    "PRESETS",
    "Channel",
    "EndedTransmission",
    "FrameFate",
    "LoraRadio",
    "Radio",
    "TimeSlotRadio",
    "WifiRadio",
    "numbers",
]

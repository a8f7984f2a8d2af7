"""Simulate a radio channel that all vehicles share. The module `_channel.py` describes the model."""

from netem.channel._channel import Channel
from netem.channel._frame import Fate, Transmission, numbers
from netem.channel._parameters import Chirps, Contention, Radio, Turns
from netem.channel._presets import PRESETS

__all__ = ["PRESETS", "Channel", "Chirps", "Contention", "Fate", "Radio", "Transmission", "Turns", "numbers"]

"""Describe the radio channel of a scenario, which all vehicles share.

A preset sets all numeric values of the radio, and the other keys replace single values. `netem.channel` defines the
model, the presets with their sources, and the limits of each value. A key that the preset's kind of radio does not have
is an error.
"""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from harness.scenario.strict_model import StrictModel

if TYPE_CHECKING:
    from netem.channel import Radio

Preset = Literal[
    "wifi_1",
    "wifi_6",
    "wifi_11",
    "rfd900",
    "lora_sf7",
    "lora_sf8",
    "lora_sf9",
    "lora_sf10",
    "lora_sf11",
    "lora_sf12",
]

OWN_KEYS = ("preset", "processing_s")
"""Keys of the channel that are not numeric values of the radio."""


class ChannelModel(StrictModel):
    """A radio channel that all vehicles share. The keys other than `preset` replace numeric values of the preset."""

    preset: Preset
    """The kind of radio: 802.11 ad hoc at 1, 6 or 11 Mbit/s, a telemetry radio with time slots (RFD900 class), or LoRa
    with spreading factor 7 to 12.
    """
    processing_s: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)] = 0.005
    """Maximum time in seconds from the decision to send a message until the radio receives the message for sending. The
    time of each message is random, uniform from 0 to this value.
    """
    power_dbm: float | None = None
    """Transmit power in dBm."""
    sensitivity_dbm: float | None = None
    """Minimum received power in dBm. A frame with less power is lost."""
    noise_dbm: float | None = None
    """Noise of the receiver in dBm."""
    preamble_db: float | None = None
    """Minimum ratio in decibels between the power of a frame and the power of noise and other frames, at which a
    receiver begins to receive the frame.
    """
    sinr_db: float | None = None
    """Minimum ratio in decibels between the power of a frame and the power of noise and other frames, while a receiver
    receives the frame.
    """
    capture_window_s: float | None = None
    """Seconds after the beginning of a frame during which its receiver changes to a stronger frame."""
    frequency_hz: float | None = None
    """Carrier frequency in hertz."""
    exponent: float | None = None
    """Path loss exponent."""
    shadowing_db: float | None = None
    """Standard deviation of the shadowing in decibels."""
    shadowing_m: float | None = None
    """Metres that a vehicle moves until the correlation of the shadowing has fallen to 37 %. With 0, each frame has its
    own random shadowing.
    """
    shadowing_s: float | None = None
    """Seconds until the correlation of the shadowing has fallen to 37 %. With 0, each frame has its own random
    shadowing.
    """
    ground: Literal["none", "two_ray"] | None = None
    """`two_ray`: the ground reflects the signal, which limits the range of low antennas. `none`: no ground."""
    antenna_m: float | None = None
    """Height of the antenna above the vehicle in metres, for `ground: two_ray`."""
    header_bytes: int | None = None
    """Bytes of a frame in addition to the data of the message."""
    largest_bytes: int | None = None
    """Largest message in bytes. A longer message is not sent."""
    queue_frames: int | None = None
    """Number of messages that may wait in a radio. Further messages are dropped."""
    rate_bps: float | None = None
    """802.11 and telemetry radio: bits per second on the air."""
    preamble_s: float | None = None
    """802.11 and telemetry radio: duration in seconds of the part of a frame before its first byte."""
    symbol_s: float | None = None
    """802.11: duration of a symbol in seconds. A frame consists of whole symbols."""
    padding_bits: int | None = None
    """802.11: bits of a frame in addition to its bytes."""
    extension_s: float | None = None
    """802.11: seconds of silence that count as part of a frame, at its end."""
    slot_s: float | None = None
    """802.11: duration of a slot of the backoff in seconds."""
    difs_s: float | None = None
    """802.11: seconds that the channel must be idle before a station begins to count slots."""
    eifs_s: float | None = None
    """802.11: seconds that the channel must be idle after a frame with an error, in place of `difs_s`. At least
    `difs_s`.
    """
    contention_window: int | None = None
    """802.11: maximum number of slots of a backoff."""
    sense_s: float | None = None
    """802.11: seconds until a station senses that a frame has begun."""
    energy_dbm: float | None = None
    """802.11: minimum received power in dBm at which a station senses a frame that it does not receive."""
    turn_s: float | None = None
    """Telemetry radio: duration of the time slot of a vehicle in seconds."""
    guard_s: float | None = None
    """Telemetry radio: seconds of silence at the end of a time slot."""
    duty: float | None = None
    """Telemetry radio and LoRa: maximum share of the time in which a radio may send, up to 1."""
    spreading_factor: int | None = None
    """LoRa: spreading factor, 6 to 12."""
    bandwidth_hz: float | None = None
    """LoRa: bandwidth in hertz."""
    coding_rate: int | None = None
    """LoRa: number of bits that carry four bits of data, 5 to 8."""
    preamble_symbols: int | None = None
    """LoRa: number of symbols of the preamble, without the 4.25 symbols that follow it."""

    def radio(self) -> "Radio":
        """Return the radio model. Raises ValueError for a value out of range, or for a key that this kind of radio does
        not have.
        """
        from dataclasses import fields, replace

        from netem.channel import PRESETS

        radio = PRESETS[self.preset]
        allowed = {field.name for field in fields(radio)}
        for key in self._figures():
            if key not in allowed:
                raise ValueError(f"`{key}` is not a key of the radio preset {self.preset}: leave it out")
        return replace(radio, **self._figures())

    def to_json(self) -> dict[str, Any]:
        """Return the preset, the processing time and all numeric values of the radio model as JSON."""
        from dataclasses import asdict

        return {**{key: getattr(self, key) for key in OWN_KEYS}, **asdict(self.radio())}

    def _figures(self) -> dict[str, Any]:
        given = self.model_dump(exclude_none=True)
        return {key: value for key, value in given.items() if key not in OWN_KEYS}

    @model_validator(mode="after")
    def _check_values(self) -> "ChannelModel":
        self.radio()
        return self

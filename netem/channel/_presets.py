"""Define the presets: radios with properties from standards and data sheets."""

from __future__ import annotations

import math

from netem.channel._parameters import LoraRadio, Radio, TimeSlotRadio, WifiRadio

_UDP_OVER_80211 = 24 + 4 + 8 + 20 + 8
"""Number of bytes that a frame has in addition to the data. They are the MAC header and frame check sequence, the LLC
and SNAP headers, the IPv4 header, and the UDP header.
"""

_THERMAL_DBM_PER_HZ = -174.0


def _noise_dbm(bandwidth_hz: float, figure_db: float) -> float:
    return round(_THERMAL_DBM_PER_HZ + 10 * math.log10(bandwidth_hz) + figure_db, 2)


def _dsss(rate_bps: float, sinr_db: float) -> WifiRadio:
    """Return an 802.11b radio (IEEE 802.11-2020, clauses 15 and 16).

    The long preamble and PLCP header take 192 us at 1 Mbit/s (16.2.2.2). A frame takes whole microseconds (16.2.3.5).
    Slot 20 us, SIFS 10 us, CWmin 31, CCA time 15 us (Table 16-4), so DIFS is 50 us, and EIFS adds SIFS and an
    acknowledgement of 304 us at 1 Mbit/s (10.3.7). Energy detection: -76 dBm for 50 to 100 mW (16.3.8.5). `sinr_db` is
    the ratio at which half of the frames of 111 bytes arrive in ns-3's DsssErrorRateModel.
    """
    return WifiRadio(
        power_dbm=20.0,
        sensitivity_dbm=-82.0,
        noise_dbm=_noise_dbm(22e6, 7.0),
        preamble_db=4.0,
        sinr_db=sinr_db,
        capture_window_s=4e-6,
        frequency_hz=2.437e9,
        header_bytes=_UDP_OVER_80211,
        largest_bytes=2304,
        rate_bps=rate_bps,
        preamble_s=192e-6,
        symbol_s=1e-6,
        padding_bits=0,
        slot_s=20e-6,
        difs_s=50e-6,
        eifs_s=364e-6,
        contention_window=31,
        sense_s=15e-6,
        energy_dbm=-76.0,
    )


def _ofdm(rate_bps: float, sinr_db: float) -> WifiRadio:
    """Return an 802.11g radio in an ad hoc network (IEEE 802.11-2020, clauses 17 and 18).

    Preamble and SIGNAL field take 20 us, a symbol 4 us, and SERVICE and tail are 22 bits (17.3). At 2.4 GHz there is a
    signal extension of 6 us (18.3.2.4) and in an ad hoc network the slot is 20 us (18.4.5). SIFS 10 us, CWmin 15, CCA
    time below 4 us (Table 18-5), so DIFS is 50 us, and EIFS adds SIFS and an acknowledgement of 50 us. Energy
    detection: -62 dBm (17.3.10.6). `sinr_db` is the ratio at which half of the frames of 111 bytes arrive in ns-3's
    TableBasedErrorRateModel.
    """
    return WifiRadio(
        power_dbm=20.0,
        sensitivity_dbm=-82.0,
        noise_dbm=_noise_dbm(20e6, 7.0),
        preamble_db=4.0,
        sinr_db=sinr_db,
        capture_window_s=4e-6,
        frequency_hz=2.437e9,
        header_bytes=_UDP_OVER_80211,
        largest_bytes=2304,
        rate_bps=rate_bps,
        preamble_s=20e-6,
        symbol_s=4e-6,
        padding_bits=22,
        extension_s=6e-6,
        slot_s=20e-6,
        difs_s=50e-6,
        eifs_s=110e-6,
        contention_window=15,
        sense_s=4e-6,
        energy_dbm=-62.0,
    )


def _telemetry() -> TimeSlotRadio:
    """Return a radio of the RFD900 class with the multipoint firmware of SiK.

    Air rate 64 kbit/s, 1 W at 915 MHz. As in SiK (Firmware/radio/tdm.c), the latency of a packet is 13 bytes and 13
    ticks of 16 us, a turn has room for three packets of 252 bytes, and the silence after it is two latencies. The
    sensitivity is computed: a noise bandwidth of 128 kHz, a noise figure of 5 dB, and 11 dB for GFSK.
    """
    noise_dbm = _noise_dbm(128e3, 5.0)
    return TimeSlotRadio(
        power_dbm=30.0,
        sensitivity_dbm=round(noise_dbm + 11.0, 2),
        noise_dbm=noise_dbm,
        preamble_db=11.0,
        sinr_db=11.0,
        capture_window_s=0.0,
        frequency_hz=915e6,
        header_bytes=4,
        largest_bytes=752,
        rate_bps=64_000.0,
        preamble_s=1.833e-3,
        turn_s=0.1037,
        guard_s=3.7e-3,
        duty=1.0,
    )


def _lora(factor: int, sensitivity_dbm: float) -> LoraRadio:
    """Return a LoRa radio at 868 MHz with a bandwidth of 125 kHz and coding rate 4/5.

    Sensitivities: SX1276 data sheet, rev. 7, Table 10. Power 14 dBm and a duty cycle of 1 % are the limits of ETSI EN
    300 220-2 (band M). A frame survives if it is 6 dB stronger than the others with the same spreading factor (Goursaud
    and Gorce, EAI Endorsed Transactions on Internet of Things 15(1), 2015). A receiver changes to a stronger frame
    until the last five symbols of the preamble (Bor et al., Do LoRa Low-Power Wide-Area Networks Scale?, MSWiM 2016).
    The noise level is the noise that remains after despreading. A frame has at most 255 bytes.
    """
    bandwidth_hz, preamble_symbols = 125e3, 8
    return LoraRadio(
        power_dbm=14.0,
        sensitivity_dbm=sensitivity_dbm,
        noise_dbm=round(_noise_dbm(bandwidth_hz, 6.0) - 10 * math.log10(2**factor), 2),
        preamble_db=6.0,
        sinr_db=6.0,
        capture_window_s=(preamble_symbols - 5) * 2**factor / bandwidth_hz,
        frequency_hz=868.1e6,
        header_bytes=0,
        largest_bytes=255,
        spreading_factor=factor,
        bandwidth_hz=bandwidth_hz,
        coding_rate=5,
        preamble_symbols=preamble_symbols,
        duty=0.01,
    )


PRESETS: dict[str, Radio] = {
    "wifi_1": _dsss(1e6, -5.3),
    "wifi_6": _ofdm(6e6, -0.7),
    "wifi_11": _dsss(11e6, 6.0),
    "rfd900": _telemetry(),
    **{
        f"lora_sf{factor}": _lora(factor, sensitivity_dbm)
        for factor, sensitivity_dbm in zip(range(7, 13), (-123.0, -126.0, -129.0, -132.0, -133.0, -136.0), strict=True)
    },
}
"""Name of a preset, as in the key `network.channel.preset` -> its radio."""

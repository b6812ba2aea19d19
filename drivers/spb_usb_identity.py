"""Who answers at the other end of an SPB1 control plane, and what it can do (hardware.md section 8.3)."""

from dataclasses import dataclass
from fractions import Fraction

from drivers.errors import DeviceFault, DeviceNotFound, DeviceTimeout, ProtocolError
from drivers.frames import frame_bytes
from drivers.interfaces import BurstMode, SpadInfo, StreamMode
from drivers.spb1.control import IDENTITY_MAGIC, PROTOCOL_MAJOR, TEXT_BYTES, Feature, Register
from drivers.spb1.control_channel import ControlChannel


@dataclass(frozen=True, slots=True)
class Identity:
    """What the identity registers say."""

    info: SpadInfo
    features: Feature
    tick_hz: Fraction
    min_period_ticks: int
    window_entries: int
    """Of all window tables together."""
    max_stride: int


def identify(control: ControlChannel, name: str) -> Identity:
    """Ask. `DeviceNotFound` where it does not speak SPB1, `DeviceFault` where it speaks another version."""
    # A program that died may have left a run behind, which would drown the answers.
    control.forget_run()
    try:
        magic, protocol = control.read_all((Register.MAGIC, Register.PROTOCOL))
    except (DeviceTimeout, ProtocolError) as error:
        raise DeviceNotFound(f"{name} does not speak SPB1 ({error}); wrong firmware?") from None
    if magic != IDENTITY_MAGIC:
        raise DeviceNotFound(f"{name}: identity 0x{magic:08x} is not SPB1; wrong firmware, or another device")
    if protocol >> 8 != PROTOCOL_MAJOR:
        raise DeviceFault(
            f"{name} speaks SPB1 {protocol >> 8}.{protocol & 0xFF}, this driver {PROTOCOL_MAJOR}.x; "
            "update firmware or program"
        )
    features = Feature(control.read(Register.FEATURES) & int(~Feature(0)))
    size, tick, den, link, step, period, entries, max_stride = control.read_all(
        (
            *(Register.SENSOR_SIZE, Register.TICK_HZ, Register.TICK_HZ_DEN, Register.LINK_BYTES_PER_S),
            *(Register.ROI_STEP_PX, Register.MIN_PERIOD_TICKS, Register.WINDOW_ENTRIES, Register.MAX_STRIDE),
        )
    )
    if 0 in (size & 0xFFFF, size >> 16, tick, den, period, step, link, max_stride) or max_stride % 1024:
        raise ProtocolError(f"{name}: identity registers hold zeros or a stride of {max_stride}; wrong firmware?")
    tick_hz = Fraction(tick, den)
    width, height = size & 0xFFFF, size >> 16
    capacity = control.read64(Register.DDR_BYTES) // frame_bytes(width, height)
    info = SpadInfo(
        model=control.read_text(Register.MODEL, TEXT_BYTES),
        serial=control.read_text(Register.SERIAL, TEXT_BYTES) or "none",
        width=width,
        height=height,
        rotation_deg=0,
        max_frame_rate_hz=tick_hz / period,
        burst=BurstMode(capacity, float(link)) if Feature.BURST in features and capacity else None,
        stream=StreamMode(float(link)) if Feature.STREAM in features else None,
        roi_step_px=step,
        markers=Feature.MARKERS in features,
        trigger_modes=("free", "external") if Feature.EXTERNAL_TRIGGER in features else ("free",),
    )
    return Identity(info, features, tick_hz, period, entries, max_stride)

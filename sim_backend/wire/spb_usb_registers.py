"""What an emulated SPB1 device is: its USB descriptors and its registers (docs/spb1-usb.md)."""

from typing import Final, Literal

from drivers.spb1.control import IDENTITY_MAGIC, TEXT_BYTES, Feature, Register
from sim_backend.wire.usb_descriptors import AlternateSpec, DeviceSpec, EndpointSpec

Chip = Literal["fx3", "ft601"]

_PACKET = 1024
WRITABLE: Final = frozenset(
    (
        Register.HEARTBEAT_MS,
        Register.PERIOD_TICKS,
        Register.EXPOSURE_TICKS,
        Register.MODE,
        Register.STRIDE,
        Register.BLOCK_FRAMES,
        Register.N_FRAMES,
        Register.N_FRAMES + 4,
        Register.WINDOW_WIDTH_PX,
        Register.WINDOW_SWEEPS,
        Register.TEST_PATTERN,
        Register.WINDOW_COUNTS,
        Register.WINDOW_COUNTS + 4,
    )
)


def device_spec(chip: Chip, acks: str, serial: str | None, product_name: str) -> DeviceSpec:
    """FX3: 04B4:00F1, one interface. FT601: 0403:601F, interface 0 for its session, interface 1 for data."""
    bulk = [EndpointSpec(address, "bulk", _PACKET) for address in (0x01, 0x81)]
    if chip == "fx3":
        if acks == "endpoint":
            bulk.append(EndpointSpec(0x82, "bulk", _PACKET))
        return DeviceSpec(0x04B4, 0x00F1, "spadrig", product_name, serial, "super", (AlternateSpec(0, 0, tuple(bulk)),))
    session = (EndpointSpec(0x01, "bulk", _PACKET), EndpointSpec(0x81, "interrupt", 64, 1))
    data = [EndpointSpec(address, "bulk", _PACKET) for address in (0x02, 0x82)]
    if acks == "endpoint":
        data.append(EndpointSpec(0x83, "bulk", _PACKET))
    alternates = (AlternateSpec(0, 0, session), AlternateSpec(1, 0, tuple(data)))
    return DeviceSpec(0x0403, 0x601F, "FTDI", product_name, serial, "super", alternates)


def registers_at_power_up(
    width: int,
    height: int,
    serial: str,
    tick_hz: int,
    min_period_ticks: int,
    ddr_bytes: int,
    max_stride: int,
    link_bytes_per_s: int,
    protocol: int,
    features: Feature,
) -> dict[int, int]:
    """All of them by address, those that nobody wrote yet 0."""
    registers = dict.fromkeys(WRITABLE, 0)
    registers |= {
        Register.MAGIC: IDENTITY_MAGIC,
        Register.PROTOCOL: protocol,
        Register.SENSOR_SIZE: width | height << 16,
        Register.TICK_HZ: tick_hz,
        Register.TICK_HZ_DEN: 1,
        Register.DDR_BYTES: ddr_bytes & 0xFFFFFFFF,
        Register.DDR_BYTES + 4: ddr_bytes >> 32,
        Register.MAX_STRIDE: max_stride,
        Register.FEATURES: int(features) & 0x3F,
        Register.ROI_STEP_PX: 64,
        Register.MIN_PERIOD_TICKS: min_period_ticks,
        Register.LINK_BYTES_PER_S: link_bytes_per_s,
        Register.WINDOW_ENTRIES: 4096,
        Register.FIFO_HIGH_WATER: 0,
        Register.STRIDE: max_stride,
    }
    for register, text in ((Register.MODEL, "emulated SPB1"), (Register.SERIAL, serial)):
        raw = text.encode().ljust(TEXT_BYTES, b"\0")
        for at in range(0, TEXT_BYTES, 4):
            registers[register + at] = int.from_bytes(raw[at : at + 4], "little")
    return registers

"""`lgmdjax servos map`: ask the user which servo is which joint, and write the joint map."""

import time

from lgmdjax.cli.hardware_flags import ServosMapFlags
from lgmdjax.errors import InputError
from lgmdjax.hardware import joint_map, servo_mapping
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.servo_bus import BusLost, ServoBus
from lgmdjax.runtime import partial_files


def map_servos(flags: ServosMapFlags) -> None:
    """Map the servos of a bus and write the file; print its lines."""
    if flags.out.exists():
        raise InputError(
            f"expected a new file for the joint map, got {flags.out}, which exists; name another with --out"
        )
    partial_files.require_writable(flags.out.parent)  # before eighteen questions are asked
    clock = Clock(flags.speed)
    with ServoBus(flags.servos, flags.baud, clock) as bus:
        try:
            found = bus.find(range(flags.highest_id + 1))
            mapper = servo_mapping.Mapper(bus=bus, clock=clock, ask=_ask, wait=time.sleep)
            servos = mapper.map(sorted(found), flags.baud)
        except BusLost as error:
            raise InputError(f"expected a bus with servos, got {error}; check power and cables") from error
        finally:
            bus.release(())
    joint_map.write(flags.out, servos)
    joint_map.read(flags.out)
    print(servo_mapping.describe(servos))
    print(flags.out)


def _ask(question: str) -> str:
    try:
        return input(f"{question} ")
    except EOFError as error:
        raise InputError("expected an answer, got the end of the input; nothing is written, start again") from error

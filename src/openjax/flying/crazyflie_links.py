"""Set-points to a vehicle, packets that never wait, and a restart: what is done with
`cflib`'s links.
"""

from time import sleep

from openjax.flying.set_point import OFF, SetPoint, manual_arguments

BOOT = {"udp": 0.2, "radio": 5.0}
"""Time that a restarted vehicle takes to answer (s)."""


def send_set_point(crazyflie, set_point: SetPoint) -> None:
    """Send one vehicle its set-point. `crazyflie`: its own, or its link: it needs no
    more than `send_packet`.
    """
    from cflib.crazyflie.commander import Commander

    commander = Commander(crazyflie)
    if set_point.mode == OFF:
        commander.send_stop_setpoint()
    else:
        commander.send_setpoint_manual(*manual_arguments(set_point))


def never_wait(link) -> None:
    """Have packets wait for a link, and never who sends them: the newest of each kind, in the place
    of an older one.

    A radio's link has room for one until its vehicle acknowledges; `cflib` waits two seconds for a
    vehicle that doesn't, and meanwhile sends the others nothing. Over UDP nothing waits.
    """
    room = getattr(link, "out_queue", None)

    def send_packet(packet) -> bool:
        with room.mutex:
            waiting = [old.header for old in room.queue]
            if packet.header in waiting:
                room.queue[waiting.index(packet.header)] = packet
            else:
                room.queue.append(packet)
                room.not_empty.notify()
        return True

    if room is not None:
        link.send_packet = send_packet


def restart(uri: str, crazyflie) -> None:
    """Restart a vehicle whose firmware is locked: its motors are off."""
    from cflib.utils.power_switch import PowerSwitch

    crazyflie.close_link()
    switch = PowerSwitch(uri)
    switch.stm_power_cycle()
    switch.close()
    sleep(BOOT[uri.split(":")[0]])

"""What makes a process fit for real time."""

import subprocess
import sys

CHECK = """
import gc
from openjax.flying import real_time, swarm
real_time.hurry()
left = len(gc.get_objects())
assert gc.get_freeze_count() > 10 * left, left
"""


def test_the_garbage_collector_never_stops_a_process_in_a_hurry_for_long():
    """It doesn't look again at what was loaded: .1 s with JAX, and three virtual
    vehicles lost their poses at once.
    """
    subprocess.run([sys.executable, "-c", CHECK], check=True, timeout=60)

"""From poses to set-points: the loop that flies a policy on Crazyflies, its safety, and a virtual Crazyflie.

Nothing here is imported by the rest of openjax, and `cflib` (GPLv3, an extra) by `openjax.flying.swarm` only.
"""

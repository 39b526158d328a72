"""From poses to set-points: the loop that flies a policy on Crazyflies, what judges its
poses and actions, who lands for whom.

Nothing here is imported by the rest of openjax but the virtual Crazyflie; `cflib`
(GPLv3, an extra) by `swarm` and `raw_links` only.
"""

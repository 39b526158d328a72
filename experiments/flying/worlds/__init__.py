"""Worlds that aren't the simulator: other people's physics, or none of our code, behind
one small interface.

The game (evader, sight, observation, metrics) runs unchanged in all of them; see
`game.play`.
"""

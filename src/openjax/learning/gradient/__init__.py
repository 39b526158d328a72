"""Learning by the gradient through the simulation: one stage (`stage`), and what it
teaches at a run's start, at its end, and to fly a diagnosed vehicle.
"""

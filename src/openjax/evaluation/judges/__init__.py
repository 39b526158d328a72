"""Judges of a policy: evaders that look for its weaknesses.

Evaders that learn (`best_response`), and one that plans (`planner`). They share nothing
with `openjax.learning`, whose evaders the pursuers may have been trained against:
whoever trains a policy doesn't grade it.
"""

"""Judges of a policy: evaders that look for its weaknesses.

Evaders that learn (`best_response`), and one that plans (`planner`). They learn and
search as those of a training do, with networks, senses and seeds of their own, and play
against the policy as it is: nothing that pursuers were trained against grades them.
"""

"""Crazyflies that answer as real ones do: firmware, CRTP, radio link, vehicles; `cflib`
flies them.
"""

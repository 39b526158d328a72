"""The fit of the nominal vehicle to flights: thrust and torque constants, motor lag,
inertia.
"""

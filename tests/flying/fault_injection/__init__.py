"""Faults where they happen, in what a camera, a radio, a process or a policy sends: flown
in simulated time (`fault_worlds`, `estimates`) and in real time (`processes`).
"""

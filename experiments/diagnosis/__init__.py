"""The exam of the diagnosis: a family of simulated vehicles, sensors and flights that shares no
code with openjax.
"""

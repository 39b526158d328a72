"""What a vehicle does, before anything is said of why: the response of its torques and of its
thrust, and the numbers of a model of them, from flights in closed loop.
"""

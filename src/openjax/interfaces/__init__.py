"""The game behind other libraries' interfaces: Gymnasium, PettingZoo, JaxMARL. Each is thin; the
game stays what it is.
"""

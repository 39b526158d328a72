"""The game behind other libraries' interfaces: Gymnasium, PettingZoo, JaxMARL. Each is
thin; the game stays what it is.

With this package imported, Gymnasium knows the game by the name "openjax/Pursuit-v0".
"""

import importlib.util

ENVIRONMENT = "openjax/Pursuit-v0"
"""Its name for `gymnasium.make` and `gymnasium.make_vec`."""


def register() -> None:
    """Tell Gymnasium, where it is installed, the game's name."""
    if importlib.util.find_spec("gymnasium") is None:
        return
    from gymnasium.envs import registration

    if ENVIRONMENT not in registration.registry:
        module = "openjax.interfaces.gymnasium"
        registration.register(
            ENVIRONMENT,
            entry_point=f"{module}:PursuitEnv",
            vector_entry_point=f"{module}:PursuitVectorEnv",
        )


register()

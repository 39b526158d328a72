"""Parameters at which each effect acts, for tests."""


def typical(effect):
    """Parameters three quarters up their priors, where every effect acts."""
    priors = {name: parameter.prior for name, parameter in effect.parameters.items()}
    return {name: low + 0.75 * (high - low) for name, (low, high) in priors.items()}

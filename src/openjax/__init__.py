"""openjax: multi-quadrotor pursuit-evasion in JAX, trained in one compiled step, with a diagnosis of the sim-to-real gap."""

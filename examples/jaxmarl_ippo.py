"""JaxMARL's own IPPO on the game, its file unchanged.

python examples/jaxmarl_ippo.py JaxMARL/baselines/IPPO/ippo_ff_mabrax.py [hydra's options]
"""

import runpy
import sys

from openjax.interfaces.jaxmarl import PursuitMultiAgentEnv

# isort: split
import jaxmarl  # computes while it is imported, so openjax comes first


def make(name, **settings):
    """The game, whichever environment the trainer's configuration names."""
    return PursuitMultiAgentEnv()


jaxmarl.make = make
script, *options = sys.argv[1:]
sys.argv = [script, *options]
runpy.run_path(script, run_name="__main__")

"""The judge that is kept apart: `python -m experiments.evaders.apart --policy P --json FILE`.

Evaders by splitting (`openjax.evaluation.judges.splitting`), on weights that are done: whoever
chooses weights by it has a judge less. Records as `openjax exploit --json` writes them.
"""

import time

from experiments.evaders.judged_game import game_parser, judged_game
from openjax.evaluation.judges.settings import SplittingSettings
from openjax.evaluation.judges.splitting import Splitting
from openjax.files import write_json

NAME = "splitting"


def main() -> None:
    """The command."""
    parser = game_parser(__doc__, episodes=32, uniform=128)
    parser.add_argument("--copies", type=int, default=SplittingSettings().copies)
    options = parser.parse_args()
    game = judged_game(options)
    settings = SplittingSettings(options.copies)
    splitting = Splitting(settings, game.environment, game.loaded.policy)
    began = time.monotonic()

    def keep(records):
        seconds = time.monotonic() - began
        write_json(options.json, {**game.flown, "records": records, "seconds": seconds})
        rates = ", ".join(f"{one['scenario']} {one['capture_rate']:.2f}" for one in records)
        print(f"{NAME}, {seconds:.0f} s: {rates}", flush=True)

    game.records(NAME, splitting.fly, keep)


if __name__ == "__main__":
    main()

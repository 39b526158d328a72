"""The judge that is kept apart: `python -m experiments.evaders.apart --policy P --json
FILE`.

Evaders by splitting (`experiments.evaders.splitting`), on weights that are done:
whoever chooses weights by it has a judge less. Records as `openjax exploit --json`
writes them.
"""

from experiments.evaders.judged_game import game_parser, judged_game
from experiments.evaders.splitting import Splitting, SplittingSettings

NAME = "splitting"


def main() -> None:
    """The command."""
    parser = game_parser(__doc__, episodes=32, uniform=128)
    parser.add_argument("--copies", type=int, default=SplittingSettings().copies)
    options = parser.parse_args()
    game = judged_game(options)
    settings = SplittingSettings(options.copies)
    splitting = Splitting(settings, game.environment, game.loaded.policy)
    found = {**game.flown, "records": [], "seconds": {}}
    game.records_kept(NAME, splitting.fly, found, options.json)


if __name__ == "__main__":
    main()

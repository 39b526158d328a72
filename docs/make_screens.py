"""Pictures of a replay and of a diagnosis' first screen: `python docs/make_screens.py`.

Writes docs/pictures/replay.png, of the page docs/extra/replay/chase.html, and
report.png, of sample flights with rotor drag that are diagnosed for it. Needs a
headless Chromium.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
COLOURS = 128  # of the palette: a picture of some 30 kB
SECONDS = {"replay": 8, "report": 2}  # that the page runs before it is taken
SIZES = {"replay": (1000, 620), "report": (1000, 940)}  # pixels


def take(page: Path, name: str, folder: Path) -> None:
    """The picture `name` of an HTML page."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"no browser: one of {', '.join(BROWSERS)} is needed")
    shot = folder / f"{name}.png"
    width, height = SIZES[name]
    options = [
        "--headless=new",
        "--no-sandbox",  # in a container it runs as root
        "--enable-unsafe-swiftshader",  # WebGL without a GPU
        "--hide-scrollbars",
        f"--virtual-time-budget={1000 * SECONDS[name]}",
        f"--window-size={width},{height}",
        f"--screenshot={shot}",
    ]
    subprocess.run(
        [browser, *options, page.resolve().as_uri()], check=True, capture_output=True
    )
    picture = (
        Image.open(shot).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    )
    picture.save(DOCS / "pictures" / f"{name}.png", optimize=True)


def diagnosed(folder: Path) -> Path:
    """The report of sample flights in a folder."""
    for words in (
        ("sample_flights", "flights", "--effect", "rotor_drag"),
        ("diagnose", "flights"),
    ):
        subprocess.run(
            [sys.executable, "-m", "openjax", *words], cwd=folder, check=True
        )
    return folder / "diagnosis" / "flights" / "report.html"


def main() -> None:
    """Both pictures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        take(DOCS / "extra" / "replay" / "chase.html", "replay", folder)
        take(diagnosed(folder), "report", folder)


if __name__ == "__main__":
    main()

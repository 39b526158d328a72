"""Pictures of a replay and of a diagnosis' first screen: `python docs/make_screens.py
[replay] [report]`.

Writes docs/pictures/replay.png, of the page docs/extra/replay/chase.html, and
report.png, of sample flights with rotor drag that are diagnosed for it. Needs a
headless Chromium, or, for the report, PyQt6-WebEngine (which has no WebGL without a
display).
"""

import os
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
SIZES = {"replay": (1000, 620), "report": (1200, 940)}  # pixels


def take(page: Path, name: str, folder: Path) -> None:
    """The picture `name` of an HTML page."""
    shot = folder / f"{name}.png"
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        by_qt(page, name, shot)
    else:
        by_browser(browser, page, name, shot)
    picture = Image.open(shot).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    picture.save(DOCS / "pictures" / f"{name}.png", optimize=True)


def by_browser(browser: str, page: Path, name: str, shot: Path) -> None:
    """What a headless Chromium shows of a page."""
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
    subprocess.run([browser, *options, page.resolve().as_uri()], check=True, capture_output=True)


def by_qt(page: Path, name: str, shot: Path) -> None:
    """What Qt's Chromium shows of a page, without a display."""
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    os.environ.setdefault("QTWEBENGINE_DISABLE_SANDBOX", "1")
    os.environ.setdefault("QTWEBENGINE_CHROMIUM_FLAGS", "--disable-gpu")
    try:
        from PyQt6.QtCore import QTimer, QUrl
        from PyQt6.QtWebEngineWidgets import QWebEngineView
        from PyQt6.QtWidgets import QApplication
    except ImportError:
        sys.exit(f"one of {', '.join(BROWSERS)} or PyQt6-WebEngine is needed")
    application = QApplication.instance() or QApplication(sys.argv[:1])
    view = QWebEngineView()
    view.resize(*SIZES[name])
    settings = view.page().settings()
    settings.setAttribute(settings.WebAttribute.ShowScrollBars, False)

    def grab():
        view.grab().save(str(shot))
        application.quit()

    wait = 1000 * SECONDS[name]
    view.loadFinished.connect(lambda _: QTimer.singleShot(wait, grab))
    view.load(QUrl.fromLocalFile(str(page.resolve())))
    view.show()
    application.exec()


def diagnosed(folder: Path) -> Path:
    """The report of sample flights in a folder."""
    for words in (
        ("sample_flights", "flights", "--effect", "rotor_drag"),
        ("diagnose", "flights"),
    ):
        subprocess.run([sys.executable, "-m", "openjax", *words], cwd=folder, check=True)
    return folder / "diagnosis" / "flights" / "report.html"


def main(names: list[str]) -> None:
    """The pictures of these names, by default all."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "replay" in names:
            take(DOCS / "extra" / "replay" / "chase.html", "replay", folder)
        if "report" in names:
            take(diagnosed(folder), "report", folder)


if __name__ == "__main__":
    main(sys.argv[1:] or list(SIZES))

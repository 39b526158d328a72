"""The effects' names without their code, which is written in JAX: for a command's
help.
"""

from pathlib import Path


def effect_names() -> tuple[str, ...]:
    """Names of all effects, sorted: each is a file in `effects` that defines `EFFECT`,
    and the file has its name.
    """
    files = sorted((Path(__file__).parent / "effects").glob("*.py"))
    return tuple(file.stem for file in files if "\nEFFECT = " in file.read_text(encoding="utf-8"))

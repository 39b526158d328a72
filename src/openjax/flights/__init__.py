"""Flight logs: containers, formats, importers and checks. Knows no effect."""

from openjax.lazy import lazy_names

# reading pulls in the vehicle (and JAX); the containers alone stay light to import
__getattr__, __dir__, __all__ = lazy_names(
    __name__, {"case": "load_case", "flight": "Case Flight Issue"}
)

"""Settings of the whole suite: it compiles much and computes little, so the compiler may leave out costly passes."""

import os
from importlib.metadata import version

_flags = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
if version("jaxlib").startswith("0.10."):
    # its way of fusing compiles three times as long; later versions know no such flag
    _flags += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", _flags)
os.environ.setdefault("JAX_PLATFORMS", "cpu")

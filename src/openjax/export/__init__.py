"""A policy for programs that don't know openjax: ONNX, a serialised JAX function, or
C99.
"""

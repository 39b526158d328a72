"""Pursuers against evaders: who catches whom."""

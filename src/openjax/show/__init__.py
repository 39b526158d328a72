"""Displays for people: progress, metrics, plots and animations."""

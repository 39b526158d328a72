"""What people look at: progress, metrics, plots and animations."""

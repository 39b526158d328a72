"""The linear-Gaussian model: residuals, nuisances, noise, fits, cross-validation."""

"""Training on several devices and hosts, and compiling for them."""

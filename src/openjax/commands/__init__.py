"""The commands: a command line each, and what is printed; the work is done in other rooms."""

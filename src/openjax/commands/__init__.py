"""What the commands are made of: command lines, a training run from start to end, evaluation,
validation.
"""

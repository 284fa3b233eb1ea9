"""Runs on disk: the directory, checkpoints, and the loop that keeps them."""

"""What a run shows: scenes, replays, figures, the report."""

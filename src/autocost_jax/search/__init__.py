"""The search for costs: where it starts, what it asks for, its stages, the loop."""

"""The belief over the route (II-C): what a view and a move do to it, on a grid or by particles, and its summary."""

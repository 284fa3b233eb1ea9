"""How a world moves: MuJoCo's models, MJX, and equations of motion in closed form."""

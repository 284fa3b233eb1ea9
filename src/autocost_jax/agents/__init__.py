"""The learners: PPO, PPO-Lagrangian and CPO."""

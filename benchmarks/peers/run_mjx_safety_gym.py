"""mjx-safety-gym's GoToGoal, a batch of worlds with uniform actions."""

import sys

from batched import measure
from mjx_safety_gym.envs.go_to_goal import GoToGoal

env = GoToGoal()
measure(env.reset, env.step, env.action_size, batch=int(sys.argv[1]), num_steps=3)

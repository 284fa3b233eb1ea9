"""crax-bench's safe_goal_point level 1, a batch of worlds with uniform actions."""

import sys

from batched import measure
from crax.envs import get_environment

env = get_environment("safe_goal_point", level=1)
measure(env.reset, env.step, env.action_size, batch=int(sys.argv[1]), num_steps=20)

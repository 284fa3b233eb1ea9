"""One Safety-Gymnasium process: env steps a second, its resets not counted."""

import json
import sys
import time

import safety_gymnasium

env = safety_gymnasium.make(sys.argv[1])
env.action_space.seed(0)
env.reset(seed=0)
for _ in range(200):  # warm up
    env.step(env.action_space.sample())
best = 0.0
for episode in range(3):
    env.reset(seed=episode)
    start = time.perf_counter()
    for _ in range(900):
        env.step(env.action_space.sample())
    best = max(best, 900 / (time.perf_counter() - start))
print(json.dumps({"env_steps_per_second": round(best)}))

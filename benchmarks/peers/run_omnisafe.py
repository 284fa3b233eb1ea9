"""One omnisafe run, nets 64-64: env steps a second with updates, start-up apart."""

import json
import sys
import time

import omnisafe

algorithm, passes, steps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
config = {
    "train_cfgs": {"total_steps": steps, "vector_env_nums": 1, "torch_threads": 2},
    "algo_cfgs": {"steps_per_epoch": steps, "update_iters": passes, "batch_size": 1000},
    "logger_cfgs": {"use_wandb": False, "use_tensorboard": False},
    "model_cfgs": {
        "actor": {"hidden_sizes": [64, 64]},
        "critic": {"hidden_sizes": [64, 64]},
    },
}
agent = omnisafe.Agent(algorithm, "SafetyPointGoal1-v0", custom_cfgs=config)
start = time.perf_counter()
agent.learn()
rate = steps / (time.perf_counter() - start)
print(json.dumps({"env_steps_per_second": round(rate)}))

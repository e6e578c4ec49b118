"""tdgc: hierarchical quadruped navigation, from task-level decisions to gait-level control.

Importing the package registers its Gymnasium environments, which ``ENVIRONMENTS`` lists.
"""

import gymnasium

__version__ = "0.1.0"

#: Gymnasium id -> location of its class; the module is imported when an environment is made.
ENVIRONMENTS = {
    "tdgc/LowLevel-v0": "tdgc.tasks.low_env:LowLevelEnv",
    "tdgc/Navigation-v0": "tdgc.tasks.high_env:NavigationEnv",
}

for _id, _entry_point in ENVIRONMENTS.items():
    gymnasium.register(_id, entry_point=_entry_point)

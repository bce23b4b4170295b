"""Models x training seeds x checkpoints through LeRobot's own training and evaluation: `ufrnn protocol`.

The unit of scheduling is a chain: one model with one training seed is trained, then its checkpoints are evaluated one
after the other. Chains depend on nothing but the demonstrations, so any number of them may run side by side, as
processes of this machine or as jobs of a cluster. Whatever is done has a file that says so; a second run skips it.
"""

"""What can be set, each defined, documented and checked here once; nothing in it needs PyTorch.

A command line can tell that a setting is wrong before the seconds that PyTorch takes to be imported. The constructors
of the planner, the optimiser and the replay buffer take these options as arguments of their own, and check them here.
"""

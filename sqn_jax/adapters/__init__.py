"""The simulator in the interfaces of others: Gymnasium, Stable-Baselines3, gymnax.

Each module imports the library whose interface it has, and none but that: `gym` and `gym_vector`
need Gymnasium, `sb3` Stable-Baselines3 too, `gymnax` nothing. An observation is one vector here,
float32 [R + G] in 0..1: the ranges from right to left, then the goal, as in `Observation`.
"""

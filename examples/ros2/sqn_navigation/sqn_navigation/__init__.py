"""A policy of sqn_jax on a robot. All but `node` knows no ROS and needs NumPy alone."""

"""Navigators that are not learned: an oracle that knows the map, a wall follower."""

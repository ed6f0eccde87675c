"""Suites of tasks: files that say on which map a robot starts and where it is to go."""

from sqn_jax.tasks.check import check_tasks
from sqn_jax.tasks.suite import Task, TaskSuite, read_suite, write_suite

__all__ = ["Task", "TaskSuite", "check_tasks", "read_suite", "write_suite"]

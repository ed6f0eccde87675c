"""Trained policies leave the project: as ONNX, and for NumPy alone.

`folder.export_policy` writes a folder that any robot's computer runs, `check.check_export` compares
what is in it with itself. `sqn_policy.py` is not imported by the others but for checks: it is the
file that goes along.
"""

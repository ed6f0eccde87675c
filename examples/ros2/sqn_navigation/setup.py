"""Installs the package for ROS 2: `colcon build --packages-select sqn_navigation`."""

from setuptools import setup

NAME = "sqn_navigation"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/loopback.launch.py"]),
        (f"share/{NAME}/config", ["config/sqn_navigation.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="the sqn_jax authors",
    maintainer_email="nobody@example.com",
    description="Drives to goals with a policy of sqn_jax",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"navigator = {NAME}.node:main"]},
)

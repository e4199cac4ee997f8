"""The package as colcon builds it."""

from glob import glob

from setuptools import setup

NAME = "bmask_slam_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.py")),
        (f"share/{NAME}/config", glob("config/*.yaml")),
        (f"share/{NAME}/rviz", glob("rviz/*.rviz")),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="the bmask-slam authors",
    maintainer_email="bmask-slam@users.noreply.github.com",
    description="bmask-slam as a node of rclpy",
    license="BSD-3-Clause",
    entry_points={"console_scripts": [f"bmask_slam = {NAME}.node:main"]},
)

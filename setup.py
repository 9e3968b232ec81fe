"""Install the library, the nodes and the simulation bridge, with pip or with colcon."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "vpsto_ros"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Real-time planning of contact with VP-STO: ROS 2 nodes and a simulated Franka FR3",
    author="vpsto_ros maintainers",
    author_email="vpsto-ros@example.com",
    maintainer="vpsto_ros maintainers",
    maintainer_email="vpsto-ros@example.com",
    license="Apache-2.0",
    packages=find_packages(include=["vpsto_ros", "vpsto_ros.*", "sim_bridge", "sim_bridge.*"]),
    package_data={
        "vpsto_ros": ["py.typed"],
        "vpsto_ros.robot": ["models/*.xml"],
        "vpsto_ros.contact": ["models/*.json"],
        "vpsto_ros.planning.hockey": ["models/*.npz"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + PACKAGE]),
        ("share/" + PACKAGE, ["package.xml"]),
        ("share/" + PACKAGE + "/launch", glob("launch/*.launch.py")),
        ("share/" + PACKAGE + "/config", glob("config/*.yaml")),
    ],
    python_requires=">=3.11",
    install_requires=["numpy>=1.26", "scipy>=1.11", "numba>=0.59", "pin>=3"],
    extras_require={
        # With colcon these come from the ROS installation. Only ros-jazzy-* names stick to one distribution.
        "ros": ["ros-jazzy-rclpy[fastrtps]>=7.1,<8", "ros-jazzy-common-interfaces>=5.3,<6"],
        "sim": [
            "mujoco>=4,<5",
            "joblib>=1.4",
            "matplotlib>=3.8",
            "tqdm>=4.60",
            "rosbags>=0.10.11",
            "viser>=1.0",
            "imageio[ffmpeg]>=2.30",
        ],
        "cluster": ["dask>=2024.1", "distributed>=2024.1"],
        "pycma": ["cma>=4"],
        # The planner that `vpsto experiment reach_clutter` compares with.
        "compare": ["ompl>=2,<3"],
        "test": ["pytest>=7", "pytest-xdist>=3.5", "hypothesis>=6", "distributed>=2024.1"],
        "lint": ["ruff>=0.12", "mypy>=1.11"],
    },
    entry_points={
        "console_scripts": [
            "vpsto = sim_bridge.cli:main",
            "franka_driver = sim_bridge.franka_driver:main",
            "state_estimator = vpsto_ros.nodes.state_estimator:main",
            "contact_planner = vpsto_ros.nodes.contact_planner:main",
            "mpc_planner = vpsto_ros.nodes.mpc_planner:main",
        ],
    },
    zip_safe=False,
)

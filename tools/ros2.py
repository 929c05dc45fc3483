# SPDX-License-Identifier: Apache-2.0
"""The program ``ros2`` of .venv-ros: tools/common.sh adds the lines that start Python."""

import sys

try:
    from ros2cli.cli import main
except ModuleNotFoundError as error:
    if error.name != 'ros2cli':
        raise
    sys.exit('ros2: ROS 2 is not sourced here: run ". /opt/ros/jazzy/setup.bash" first')
sys.exit(main())

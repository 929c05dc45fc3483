# SPDX-License-Identifier: Apache-2.0
# Lets ROS 2 and its programs find the packages of the virtual environment in VIRTUAL_ENV.
# Sourced by run.sh and by the activate script of .venv-ros, after the set-up script of ROS 2.
AMENT_PREFIX_PATH="$VIRTUAL_ENV:$AMENT_PREFIX_PATH"
# programs of ROS start with the interpreter of the system, which finds our packages by this
PYTHONPATH="$("$VIRTUAL_ENV/bin/python" -c \
    "import sysconfig; print(sysconfig.get_path('purelib'))"):${PYTHONPATH:-}"
# before the folder of ROS 2, whose ros2 has another interpreter
PATH="$VIRTUAL_ENV/bin:$PATH"
export AMENT_PREFIX_PATH PYTHONPATH PATH

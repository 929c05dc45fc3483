# SPDX-License-Identifier: Apache-2.0
"""
Makes ROS 2's interfaces importable where no generated code is installed.

``tables`` holds the definitions, one line each; a class is built when it is first asked for, so
importing one message reads one line.
"""

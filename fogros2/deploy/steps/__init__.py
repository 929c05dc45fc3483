# SPDX-License-Identifier: Apache-2.0
"""
The steps of one machine, in their order; each imports only those before it.

``creating``    create a machine or reuse a kept one; wait until it can be reached
``connecting``  log in, replace the host key, move SSH into the VPN and close the SSH port
``arming``      install the agent before any slow step; start the heartbeat
``joining``     bring up the machine's end of the VPN
``installing``  ROS 2, the workspaces, and Python modules that programs import
``dds``         configuration of the middleware, and its routers
``watching``    compare clocks, and ask the provider about a silent machine, while the launch runs
"""

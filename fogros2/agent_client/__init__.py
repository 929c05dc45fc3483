# SPDX-License-Identifier: Apache-2.0
"""
The robot's end of the agent's protocol.

- ``connection``: requests, and events that survive a lost connection;
- ``heartbeat``: heartbeats through the VPN, and the machine's clock;
- ``program``: the agent's program as it travels to machines.
"""

from fogros2.agent_client.connection import AgentClient, EventCallback
from fogros2.agent_client.heartbeat import Heartbeat, interval_for
from fogros2.agent_client.program import agent_program

__all__ = ['AgentClient', 'EventCallback', 'Heartbeat', 'agent_program', 'interval_for']

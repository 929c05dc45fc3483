# SPDX-License-Identifier: Apache-2.0
"""
Simulated clouds, computers, browsers and viewers, for this project's tests and benchmarks.

They are neither installed nor sent to machines; what authors of plugins need is in
``fogros2_testing``. Every Python that needs ``rigs`` finds it in one of two ways:

- The virtual environments of ``tools/setup.sh`` have a ``.pth`` file that names the folder
  ``test/``. So benchmarks, ``python -m rigs.cluster`` and helper processes under sudo, which drops
  PYTHONPATH, need no path of their own: they run the environment's interpreter.
- pytest adds ``test/`` to its path by ``pythonpath`` in ``pyproject.toml``, for ``colcon test``,
  which runs without these environments.
"""
